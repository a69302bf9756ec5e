"""Draw touches from the learned field, at random positions and recorded amplitudes."""

from __future__ import annotations

import torch
from torch import Tensor

from touchd.keypad import Layout
from touchd.training.field.learn import STEP_MM, Field

BORDER_SHARE = 0.7
"""Share of a keypad's synthetic touches near key borders, where keys can be confused."""
BORDER_MM = 2.0
"""Standard deviation of these touches across the border, mm."""


class Synthesiser:
    """Draws noiseless residuals over the touched part of the plate, `BORDER_SHARE` of them at a layout's keys."""

    def __init__(
        self, field: Field, size_mm: tuple[float, float], generator: torch.Generator, layout: Layout | None = None
    ) -> None:
        self._generator = generator
        keys = layout.key if layout else ()
        self._keys_mm = torch.tensor([[k.x_mm, k.y_mm, k.width_mm, k.height_mm] for k in keys])
        rows, self._columns = field.coefficients.shape[:2]
        self._nodes = torch.from_numpy(field.coefficients.reshape(rows * self._columns, -1))
        self._amplitude = torch.from_numpy(field.amplitude)
        self._origin_mm = torch.tensor(field.origin_mm, dtype=torch.float32)
        self._low_mm = torch.tensor(field.low_mm, dtype=torch.float32)
        self._span_mm = torch.tensor(field.high_mm, dtype=torch.float32) - self._low_mm
        self._size_mm = torch.tensor(size_mm)

    def draw(self, n: int) -> tuple[Tensor, Tensor]:
        """Draw residuals (n, inputs), and positions (n, 2) relative to the plate's centre, in units of its size."""
        position_mm = self._low_mm + self._span_mm * torch.rand((n, 2), generator=self._generator)
        if len(self._keys_mm):
            count = round(BORDER_SHARE * n)
            position_mm[:count] = self._at_borders(count)
        some = torch.randint(len(self._amplitude), (n, 1), generator=self._generator)
        return self.at(position_mm) * self._amplitude[some], position_mm / self._size_mm - 0.5

    def _at_borders(self, n: int) -> Tensor:
        """Draw positions (n, 2) near the borders of the keys."""
        key = self._keys_mm[torch.randint(len(self._keys_mm), (n,), generator=self._generator)]
        place = torch.rand((n, 2), generator=self._generator)
        across = torch.randint(2, (n, 1), generator=self._generator) == torch.arange(2)
        place = torch.where(across, place.round(), place)  # one of two opposite borders
        off_mm = BORDER_MM * torch.randn((n, 1), generator=self._generator) * across
        at_mm = key[:, :2] + key[:, 2:] * place + off_mm
        return at_mm.clamp(self._low_mm, self._low_mm + self._span_mm)

    def at(self, position_mm: Tensor) -> Tensor:
        """Evaluate the field (n, inputs) at positions (n, 2), by cubic B-splines."""
        place = (position_mm - self._origin_mm) / STEP_MM
        corner = place.floor()
        weight = _basis(place - corner)
        column, row = (corner.long()[:, :, None] + torch.arange(-1, 3)).unbind(dim=1)
        index = (row[:, :, None] * self._columns + column[:, None, :]).reshape(-1, 16)
        share = (weight[:, 1, :, None] * weight[:, 0, None, :]).reshape(-1, 16)
        return torch.nn.functional.embedding_bag(index, self._nodes, per_sample_weights=share, mode="sum")


def _basis(t: Tensor) -> Tensor:
    """Return the four non-zero cubic B-splines at t, 0 <= t < 1, as a last axis of 4."""
    return torch.stack([(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3], dim=-1) / 6
