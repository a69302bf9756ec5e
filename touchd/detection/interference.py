"""What is no finger in a touched frame: tones, impulses, hum, and a plate that rings from a knock."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from msgspec.structs import replace
from numpy.typing import DTypeLike, NDArray

from touchd.detection.baseline import Baseline, Signal
from touchd.detection.detection import Detection
from touchd.detection.gate import Gate
from touchd.detection.hum import FAR_BELOW
from touchd.detection.impulses import Impulses
from touchd.detection.other_chirp import OtherChirp
from touchd.detection.tones import Tones
from touchd.frame import Acquisition
from touchd.outcome import Outcome

USUAL_HZ = 50e3
"""Lower edge of the band that times are stated for: what rings below a lower one takes longer to fade, in proportion.
"""
IN_BAND_NS = 16_000_000
"""A knock may ring in the band for so long: there glass fades by 60 dB in it."""
CLIPS_NS = 80_000_000
"""And clip for so long, where nothing before the ADC takes out its low frequencies."""
FADES_NS, FADED = 30_000_000, 4.0
"""After this time a knock has faded by this factor in energy, above 8 kHz: glass with a loss factor of 0.005 by 60 dB.
A rise by it is another knock."""
_BESIDE = 1.6 * FAR_BELOW, 1.2
"""Of hum and of sound that are taken out something is left up to these shares of the band's lower edge."""
_SOUND_S, _LOOK_S, _MOST_SOUNDS = 1.5, 0.1, 0.4
"""There is sound if this share of some 1.5 s tells it: a knock fades in 0.1 s, for which a frame stands at most."""


class Interference:
    """Takes what is no finger out of the baseline's residual.

    Parameters
    ----------
    acquisition : Acquisition
    baseline : Baseline
    gate : Gate
        Decides again about what is left.
    on_found : callable
        Called with the time, ns, by which another pane's chirp arrives earlier in each frame, once it is found.
    dtype : type
        Of all arrays.
    """

    def __init__(
        self, acquisition: Acquisition, baseline: Baseline, gate: Gate, on_found: Callable[[float], None],
        dtype: DTypeLike,
    ) -> None:  # fmt: skip
        self.tones = Tones(acquisition, dtype)
        self.other_chirp = OtherChirp(acquisition, dtype, on_found)
        self._impulses = [Impulses(acquisition, dtype, above=above) for above in (0.0, *_BESIDE)]
        self._baseline, self._gate = baseline, gate
        self._sounds, self._sounded_ns = 0.0, 0  # share of the last time that was louder below the band than noise
        slower = USUAL_HZ / acquisition.chirp.band_hz[0]
        self._in_band_ns, self._fades_ns = round(IN_BAND_NS * slower), round(FADES_NS * slower)
        self._loudness = self._loudest = 0.0
        self._heard_ns = self._knocked_ns = -CLIPS_NS
        self._top = 2 ** (acquisition.bits - 1) - 1

    @property
    def impulses(self) -> Impulses:
        """What finds impulses: with hum and sound by fewer frequencies."""
        return self._impulses[2 if self._baseline.sound.known else self._baseline.hum.known]

    def learn(self, frames: Signal) -> NDArray[np.bool_]:
        """Learn the noise from untouched frames, (n, channels, samples); return which an impulse has hit, (n,)."""
        self._sounds = 0.0
        hits = {each: each.learn(frames) for each in self._impulses}
        return hits[self.impulses]

    def update(self, t_ns: int, residual: Signal) -> None:
        """Follow the noise by an untouched frame, (channels, samples)."""
        for each in self._impulses:
            each.update(residual)
        baseline = self._baseline
        self.other_chirp.watch(self._gate.noise_energy)
        if baseline.awaits_sound:
            energy = baseline.residual_energy() + baseline.drive_energy
            self._hear(t_ns, loud=baseline.sound.tells(residual, energy))

    def clean(self, detection: Detection, *, listens: bool) -> Detection:
        """Take out of a touched frame's residual what is found in it; return the same detection if nothing is.

        What is left may be an untouched frame, or a plate that rings. `listens` says whether to look for tones.
        """
        baseline, gate, residual = self._baseline, self._gate, detection.residual
        energy, touched, changed = detection.energy, True, False
        if found := listens and self.tones.find(residual, gate.noise_energy):
            energy, touched = self._again()
            changed = not touched and gate.update(energy)
        since_ns = detection.t_ns - self._knocked_ns
        clips = touched and 0 <= since_ns < CLIPS_NS and baseline.clips(self._top)
        hums = touched and not clips and self._hums(detection, energy)
        hits = self.impulses.blank(residual, energy) if touched and not (hums or clips) else ()
        if hits or hums:  # without them the plate may be untouched
            energy, touched = self._again()
            changed = hums and not touched and gate.update(energy)  # noise is not learned from a frame with an impulse
        rings = clips
        if knocked := touched and not (hits or clips) and self._rings(detection, energy):
            # Low frequencies ring longest.
            baseline.sound.remove(residual)
            energy, touched = self._again()
            self._hear(detection.t_ns, loud=not touched)
            in_band = 0 <= detection.t_ns - self._knocked_ns < self._in_band_ns
            rings = touched and (in_band or self._is_loud(residual, energy) or baseline.clips(self._top))
        sounds = touched and self.impulses.in_vain > 0
        if not (found or hits or hums or knocked or clips or sounds):
            return detection
        return replace(
            detection, outcome=Outcome.TOUCHED if touched else Outcome.UNTOUCHED, energy=energy, noise_changed=changed,
            noise_root=gate.noise_root, noise_deviation=gate.noise_deviation, tones_hz=self.tones.known_hz, hits=hits,
            rings=rings, sounds=sounds,
        )  # fmt: skip

    def _hear(self, t_ns: int, *, loud: bool) -> None:
        """Follow for which share of the time the plate is louder below the band than noise: longer, and it is sound."""
        gone_s = max(t_ns - self._sounded_ns, 0) * 1e-9
        self._sounded_ns = t_ns
        self._sounds = (_SOUND_S * self._sounds + loud * min(gone_s, _LOOK_S)) / (_SOUND_S + gone_s)
        if self._sounds > _MOST_SOUNDS and self._baseline.awaits_sound:
            self._baseline.take_out_sound()

    def _rings(self, detection: Detection, energy: float) -> bool:
        """Return whether a frame in which no impulse was found is louder outside the band, as after a knock.

        That fades within milliseconds, and noise does not.
        """
        t_ns = detection.t_ns
        before = self._loudness if 0 <= t_ns - self._heard_ns < self._fades_ns else 0.0
        self._heard_ns = t_ns
        self._loudness = loudness = self.impulses.loudness(detection.residual) if self.impulses.in_vain else 0.0
        if loudness <= self.impulses.most(energy):
            return False
        if loudness > FADED * before:
            self._knocked_ns, self._loudest = t_ns, loudness
        self._loudest = max(self._loudest, loudness)
        return FADED * loudness < self._loudest or 0 <= t_ns - self._knocked_ns < self._fades_ns

    def _is_loud(self, residual: Signal, energy: float) -> bool:
        return self.impulses.loudness(residual) > self.impulses.most(energy)

    def _again(self) -> tuple[float, bool]:
        """Return the energy of what is left, and whether the plate is still touched."""
        energy = self._baseline.residual_energy()
        return energy, self._gate.decide_again(energy)

    def _hums(self, detection: Detection, energy: float) -> bool:
        """Look for hum that has begun, and take it out; an impulse and a knock have low frequencies, too."""
        hum, residual = self._baseline.hum, detection.residual
        whole = energy + self._baseline.drive_energy
        if not hum.find(residual, whole, self._gate.noise_energy):
            return False
        if self._is_loud(residual, self._baseline.residual_energy()):
            hum.put_back(residual)
            return False
        return True
