"""Augment recorded touches: noise, other fingers, other temperatures; and generate non-fingers.

Features are linear in the samples, so each disturbance is added to features, where the instrument would add it.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from touchd.evaluation.dataset import BASELINE_NOISE, Dataset
from touchd.localization.features import Features
from touchd.training.data.synthetic import Synthesiser

# Phases relative to the recorded touches, rad (twin). On the reference plate, human fingers of 25-100 mm^2 lie -0.3 to
# 0.2 from the silicone finger and turn by less than 0.1 over the band. A drop of water, a pure mass, leads by 0.5 at
# the band's lower end and by 0.8 at its upper. A finger that leaves the baseline is pi away.
FINGER_PHASE = 0.33
FINGER_TURN = 0.2
OTHER_PHASE = 0.52
OTHER_TURN = 0.6


class Augmenter:
    """Draws batches of fingers and non-fingers from recorded touches, a synthesiser, noise and tones.

    It draws from the touches `indices` (n,) of a dataset in the frequency domain, and from `pool` rows of noise and of
    tones.
    """

    def __init__(
        self,
        dataset: Dataset,
        indices: Tensor,
        synthesiser: Synthesiser,
        generator: torch.Generator,
        pool: int = 8192,
    ) -> None:
        a = dataset.acquisition
        features = Features(dataset.domain, a, taper=dataset.taper)
        self.synthesiser = synthesiser
        self._generator = generator
        self._channels, self._bins = a.channels, features.size // a.channels // 2
        self.residual = torch.from_numpy(dataset.residual)[indices]
        self._untouched = torch.from_numpy(dataset.untouched)[indices]
        self._stretch = torch.from_numpy(dataset.stretch)[indices]
        self._delay = torch.from_numpy(dataset.delay)[indices]
        position_mm = torch.from_numpy(dataset.position_mm)[indices]
        self.position = position_mm / torch.tensor(dataset.meta.plate.size_mm) - 0.5
        """Relative to the plate's centre, in units of its size, shape (n, 2)."""
        nearest = torch.cdist(position_mm, position_mm).topk(min(24, len(indices)), largest=False)
        self.neighbours = nearest.indices
        """Indices of the nearest touches of each touch, shape (n, k)."""
        white = torch.randn((pool, a.channels, a.samples), generator=generator) * dataset.noise
        tones = _features_of(features, _tones(pool, dataset, generator))
        self.noise = _features_of(features, white)
        """Features of white noise at the recording's level, shape (pool, inputs)."""
        self.tones: Tensor = tones / tones.norm(dim=1, keepdim=True).clamp_min(1e-6)
        """Features of tones asynchronous to the chirp, unit norm, shape (pool, inputs)."""
        self.power = self.noise.square().sum(dim=1).mean()
        """Mean energy of a row of noise."""

    def fingers(self, residual: Tensor, own_noise: Tensor) -> tuple[Tensor, Tensor]:
        """Vary finger, temperature, noise and channels of touches (n, inputs).

        `own_noise`, of shape (n, 1), is the noise deviation of each residual, relative to a recorded frame's. Return
        residuals and their expected noise-to-signal ratio, tones included, by norms, shape (n, 1).
        """
        n = len(residual)
        phase = FINGER_PHASE * self._symmetric(n)
        # 80 % of the touches have normal amplitudes; 20 % are just being put down or lifted.
        weak = self._chance(n, 0.2)
        size = weak * self._log_uniform(n, 0.05, 0.5) + (1 - weak) * self._log_uniform(n, 0.5, 5.0)
        residual = self._amplitude(residual, phase, FINGER_TURN) * size
        disturbed = residual + self._instrument(self._draw(n), share=0.3)
        tone = self._tone(n) * self._log_uniform(n, 0.02, 0.4) * residual.norm(dim=1, keepdim=True)
        tone = tone * self._chance(n, 0.15)
        level = self._uniform(n, 0.0, 1.5) + self._chance(n, 0.1) * self._log_uniform(n, 1.0, 10.0)
        white = self._noise(n, level)
        mask = self._channel_mask(n, share=0.1)
        fingers = (disturbed + tone + white) * mask
        noise = self.power * (level.square() + (own_noise * size).square()) + tone.square().sum(dim=1, keepdim=True)
        return fingers, _ratio(noise * mask.mean(dim=1, keepdim=True), fingers)

    def own_noise(self, residual: Tensor) -> float:
        """Return the noise-to-signal ratio of the median recorded residual (n, inputs), by norms."""
        return float((BASELINE_NOISE * self.power).sqrt() / residual.norm(dim=1).median().clamp_min(1e-6))

    def held_out(self, residual: Tensor, level: float) -> tuple[Tensor, Tensor]:
        """Add noise to held-out residuals, half of them with another finger's amplitude; return as `fingers`.

        `level` is the noise deviation relative to the recording's, at least 1.
        """
        n = len(residual)
        another = self._amplitude(residual, FINGER_PHASE * self._symmetric(n), FINGER_TURN)
        mixed = torch.where(torch.arange(n)[:, None] % 2 == 0, residual, another)
        added = math.sqrt(BASELINE_NOISE * (level**2 - 1.0))
        louder = mixed + self._noise(n, torch.full((n, 1), added))
        return louder, _ratio(self.power * BASELINE_NOISE * level**2, louder)

    def others(self, n: int) -> Tensor:
        """Return non-fingers, shape (n, inputs): each row one of the kinds below."""
        kinds = [self._nothing, self._out_of_phase, self._moved_baseline, self._two_fingers, self._palm, self._drift]
        each = -(-n // len(kinds))
        batch = torch.cat([kind(each) for kind in kinds])
        keep = torch.randperm(len(batch), generator=self._generator)[:n]
        noisy = batch[keep] + self._noise(n, self._uniform(n, 0.2, 1.5))
        return noisy * self._channel_mask(n, share=0.1)

    # -- non-fingers -------------------------------------------------------------------------------

    def _nothing(self, n: int) -> Tensor:
        """Noise, and tones asynchronous to the chirp."""
        level = self.power.sqrt()
        several = self._tone(n)
        for share in (0.6, 0.3):
            several = several + self._tone(n) * self._uniform(n, 0.0, 1.0) * self._chance(n, share)
        tones = several * self._log_uniform(n, 0.1, 100.0) * level
        return self._noise(n, self._uniform(n, 0.5, 2.0)) + tones * self._chance(n, 0.8)

    def _out_of_phase(self, n: int) -> Tensor:
        """Water, dirt, and fingers that leave the baseline."""
        sign = torch.where(self._symmetric(n) < 0, -1.0, 1.0)
        phase = sign * self._uniform(n, OTHER_PHASE, torch.pi)
        # 40 % are fingers leaving the baseline, the most frequent case.
        phase = torch.where(self._uniform(n, 0.0, 1.0) < 0.4, torch.pi + FINGER_PHASE * self._symmetric(n), phase)
        return self._amplitude(self._touches(n), phase, OTHER_TURN) * self._log_uniform(n, 0.5, 3.0)

    def _moved_baseline(self, n: int) -> Tensor:
        """A finger at one position, while the baseline contains it at another."""
        weight = self._log_uniform(n, 0.5, 2.0)
        return self._touches(n) - weight * self._touches(n)

    def _two_fingers(self, n: int) -> Tensor:
        """Two fingers, in 30 % of the cases three."""
        weight = self._log_uniform(n, 0.3, 1.0)
        both = self._touches(n) + weight * self._touches(n)
        third = self._touches(n) * self._uniform(n, 0.3, 1.0) * self._chance(n, 0.3)
        return (both + third) * self._log_uniform(n, 0.7, 4.0)

    def _palm(self, n: int) -> Tensor:
        """Many adjacent contacts."""
        centre = self.neighbours[self._draw(n)]
        weight = torch.rand((n, centre.shape[1], 1), generator=self._generator)
        return (self.residual[centre] * weight).sum(dim=1) * self._log_uniform(n, 0.3, 1.5)

    def _drift(self, n: int) -> Tensor:
        """Temperature, trigger jitter and gains that changed since the baseline was learned."""
        return self._instrument(self._draw(n), share=1.0) * self._log_uniform(n, 1.0, 10.0)

    # -- disturbances ------------------------------------------------------------------------------

    def _instrument(self, indices: Tensor, share: float) -> Tensor:
        """Return `share` times a random stretch (deviation 5e-7), delay (0.5 ns) and gain error (5e-4)."""
        n = len(indices)
        gains = torch.randn((n, self._channels), generator=self._generator) * 5e-4 * self._uniform(n, 0.0, 1.0)
        gains = gains.repeat_interleave(self._untouched.shape[1] // self._channels, dim=1)
        return share * (
            gains * self._untouched[indices]
            + self._normal(n) * 5e-7 * self._stretch[indices]
            + self._normal(n) * 0.5e-9 * self._delay[indices]
        )

    def _touches(self, n: int) -> Tensor:
        """Draw recorded and synthetic touches, shape (n, inputs)."""
        recorded = n // 3
        drawn, _ = self.synthesiser.draw(n - recorded)
        mixed = torch.cat([self.residual[self._draw(recorded)], drawn])
        return mixed[torch.randperm(n, generator=self._generator)]

    def _amplitude(self, residual: Tensor, phase: Tensor, turn: float) -> Tensor:
        """Multiply by a complex amplitude of phase (n, 1), which varies randomly along the band in phase and size."""
        n = len(residual)
        along = torch.linspace(-0.5, 0.5, self._bins)
        angle = phase + turn * self._symmetric(n) * along
        size = 1.0 + 0.6 * self._symmetric(n) * along
        real, imaginary = (size * angle.cos())[:, None], (size * angle.sin())[:, None]
        parts = residual.reshape(n, self._channels, 2, self._bins)
        a, b = parts[:, :, 0], parts[:, :, 1]
        return torch.stack([a * real - b * imaginary, a * imaginary + b * real], dim=2).reshape(n, -1)

    def _channel_mask(self, n: int, share: float) -> Tensor:
        """Return a mask of shape (n, inputs) that silences one channel in this share of the rows."""
        channels, inputs = self._channels, self.noise.shape[1]
        if channels < 3:
            return torch.ones((n, inputs))
        dead = torch.randint(channels, (n, 1), generator=self._generator) == torch.arange(channels)
        mask = 1.0 - dead.float() * self._chance(n, share)
        return mask.repeat_interleave(inputs // channels, dim=1)

    def _tone(self, n: int) -> Tensor:
        return self.tones[torch.randint(len(self.tones), (n,), generator=self._generator)]

    def _chance(self, n: int, share: float) -> Tensor:
        return (self._uniform(n, 0.0, 1.0) < share).float()

    def _noise(self, n: int, level: Tensor) -> Tensor:
        rows = torch.randint(len(self.noise), (n,), generator=self._generator)
        return self.noise[rows] * level * torch.where(self._symmetric(n) < 0, -1.0, 1.0)

    def _draw(self, n: int) -> Tensor:
        return torch.randint(len(self.residual), (n,), generator=self._generator)

    def _uniform(self, n: int, low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand((n, 1), generator=self._generator)

    def _symmetric(self, n: int) -> Tensor:
        return self._uniform(n, -1.0, 1.0)

    def _normal(self, n: int) -> Tensor:
        return torch.randn((n, 1), generator=self._generator)

    def _log_uniform(self, n: int, low: float, high: float) -> Tensor:
        return torch.exp(self._uniform(n, 0.0, 1.0) * torch.tensor(high / low).log()) * low


def _ratio(noise: Tensor, features: Tensor) -> Tensor:
    """Return the noise-to-signal ratio by norms, shape (n, 1), from the noise energy."""
    return (noise / features.square().sum(dim=1, keepdim=True).clamp_min(1e-12)).sqrt()


def _features_of(features: Features, signals: Tensor) -> Tensor:
    """Return the features of signals of shape (m, channels, samples)."""
    rows = torch.empty((len(signals), features.size))
    for signal, out in zip(signals.numpy(), rows.numpy(), strict=True):
        features.extract(signal, out)
    return rows


def _tones(count: int, dataset: Dataset, generator: torch.Generator) -> Tensor:
    """Return tones of random frequency around the chirp's band, with random amplitude and phase per channel."""
    a = dataset.acquisition
    low_hz, high_hz = 0.9 * a.chirp.band_hz[0], 1.1 * a.chirp.band_hz[1]
    f_hz = low_hz + (high_hz - low_hz) * torch.rand((count, 1, 1), generator=generator)
    phase = 2 * torch.pi * torch.rand((count, a.channels, 1), generator=generator)
    size = 0.3 + torch.rand((count, a.channels, 1), generator=generator)
    seconds = torch.arange(a.samples) / a.sample_rate_hz
    signal: Tensor = size * torch.cos(2 * torch.pi * f_hz * seconds + phase)
    return signal
