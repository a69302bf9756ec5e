"""From rough positions to precise ones: Gauss-Newton on the field atlas, the touches' amplitudes eliminated.

The bins d of a frame with c fingers are modelled as sum z_k u(x_k, y_k), the z_k complex and unknown. For given
positions the best z follow by linear least squares; Gauss-Newton moves the positions to shrink what is left (variable
projection: Golub and Pereyra, SIAM J. Numer. Anal. 10:413, 1973; in the form of Kaufman, BIT 15:49, 1975, which leaves
out what the amplitudes' own change adds to the second order).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import add, mul

import numpy as np
from msgspec.structs import replace

from touchd.localization import joint
from touchd.localization.atlas import Array, Atlas
from touchd.localization.contact_model import LARGE, TYPICAL, ContactModel, size_mm2
from touchd.localization.fit import SHAPE_COST, Bins, Fit, Matrix, Steps, as_points, finish, no_fit, shapes_of, sizes_of
from touchd.localization.fit_criteria import CRITERIA
from touchd.localization.spline import ContactField, Position, Shape, Spline

LONGEST_STEP_MM = 3.0
"""About a tenth of the field's wavelength: a longer step would leave the valley that it starts in."""
STILL_MM = 0.2
"""After a shorter step the next one, of second order, would be less than 0.01 mm in 95 of 100 cases (twin)."""
_SHAPE_STEPS, _SIZE_STEPS = 3, 2
_STILL_TOGETHER_MM = STILL_MM / 4
"""After a shorter step of several fingers the next one would be less than 1e-3 mm; few tracked ones step farther."""
_I = np.complex64(1j)


class GaussNewton:
    """Fits fingers to the bins of a frame.

    Parameters
    ----------
    atlas : Atlas
        Its coefficients' type is that of all arrays.
    """

    def __init__(self, atlas: Atlas) -> None:
        d, dtype = atlas.description, atlas.coefficients.dtype
        self._channels, self._bins, n = d.acquisition.channels, len(d.bins), atlas.size
        # Here each row is the real parts of all channels, then the imaginary parts, so that one product of rows with
        # rows, half by half, holds all parts of the complex ones. The rows are u, its derivatives by x and y, and d.
        order = np.arange(n).reshape(self._channels, 2, self._bins).swapaxes(0, 1).reshape(-1)
        self._order, self._back = order, np.empty_like(order)
        self._back[order] = np.arange(n)
        rows = np.zeros((4, n), dtype)
        self._field, self._known = rows[:3], rows[3]
        halves = rows.reshape(8, -1)
        self._fields, self._columns, self._value, self._value_known = halves[:6], halves.T, halves[:2], halves[6:]
        self._spline = Spline(atlas, self._field)
        self._contact_field = ContactField(atlas, self._field)
        self._contacts = ContactModel(atlas, self._contact_field)
        self._gram, self._of_gram, self._sums = np.zeros((6, 8), dtype), joint.sums_of_one(dtype), np.zeros(14, dtype)
        self._flat_gram = self._gram.reshape(-1)
        self._turn = np.zeros((2, 2), dtype)
        self._left, self._parts = np.zeros((2, n // 2), dtype), np.zeros((1, 2, n // 2), dtype)
        self._parted: tuple[Bins | None, Fit | None] = None, None  # to which `_parts` belong
        self._residual = np.zeros(n, dtype)
        self._many = np.zeros((7, n), dtype)  # two fingers; for more it grows
        self._loaded: Bins | None = None
        self._look_ups = 0
        self._mask: Array | None = None
        self._ordered_mask: Array | None = None

    def fit_one(
        self, bins: Bins, x_mm: float, y_mm: float, steps: int, shape: Shape | None = None,
        turns: Sequence[complex] = (), shares: Sequence[float] = (),
    ) -> Fit:  # fmt: skip
        """Fit one finger from a position nearby, in at most `steps` steps (at least one); of known shape, if any.

        `turns` and `shares` are the fit's, if they are known.
        """
        if bins is not self._loaded:
            self._load(bins)
        inside, look_up, most = self._spline.inside, self._look_up, steps
        x, y = inside(x_mm, y_mm)
        size, sized, less = 1.0, self._spline.loading is None, abs(turns[0]) if turns else 1.0
        while True:
            x, y = look_up(x, y, shape, size)
            self._fields.dot(self._columns, self._gram)
            self._flat_gram.dot(self._of_gram, self._sums)
            amplitude, explained, (a, b, c), (right_x, right_y), (along_x, along_y) = joint.step_of_one(
                self._sums.tolist()
            )
            size = less * abs(amplitude)
            if not sized:  # the first look, as at the reference touch, only tells how heavy the finger is
                sized, most = True, most + 1
                continue
            steps -= 1
            det = a * c - b * b
            if det <= 0:
                break  # no gradient: the position is unknown
            step_x, step_y = (c * right_x - b * right_y) / det, (a * right_y - b * right_x) / det
            length = (step_x * step_x + step_y * step_y) ** 0.5
            shorter = LONGEST_STEP_MM / length if length > LONGEST_STEP_MM else 1.0
            x, y = inside(x + shorter * step_x, y + shorter * step_y)
            if length < STILL_MM or steps <= 0:
                # What the last step explains besides, to second order: no need to look again.
                if shorter == 1.0:
                    explained += right_x * step_x + right_y * step_y
                    amplitude /= 1 + step_x * along_x + step_y * along_y
                break
        self._look_ups += most - steps
        shapes = [[amplitude * part for part in shape]] if shape else []
        left = bins.energy - explained
        return Fit(
            [(x, y)], [amplitude], [explained], ((a, b), (b, c)), left if left > 0 else 0.0, shapes, turns, 0.0, shares
        )

    def fit_several(
        self, bins: Bins, positions_mm: Sequence[Position], steps: int, still_mm: float = STILL_MM / 10,
        shapes: Sequence[Shape] = (), turns: Sequence[complex] = (), shares: Sequence[float] = (),
    ) -> Fit:  # fmt: skip
        """Fit any number of fingers jointly from positions nearby, in at most `steps` steps (at least one).

        Steps shorter than `still_mm` end it. `shapes` are the fingers', `turns` and `shares` the fit's, if known.
        """
        count = len(positions_mm)
        if not count:
            return no_fit(bins.energy)
        self._load(bins)
        inside = self._spline.inside
        at, gained = [inside(*position) for position in positions_mm], 0.0
        sizes: list[float] = []
        scattered: Array | None = None
        if self._spline.loading:
            sizes = sizes_of(joint.step(self._products(at, shapes)[1]).amplitudes, turns)
        if self._contacts.scattering and count > 1:
            z = as_points(joint.step(self._products(at, shapes, sizes)[1]).amplitudes, turns)
            bins, scattered = self._contacts.scattering.take_out(bins, at, z)
            self._load(bins)
        for step in range(steps + 1):
            at, products = self._products(at, shapes, sizes)
            found = joint.step(products)
            sizes = sizes and sizes_of(found.amplitudes, turns)
            if step == steps:
                break
            longest_mm, at = self._spline.moved(at, found.move, LONGEST_STEP_MM)
            if longest_mm < still_mm:
                # What the last step changes, to second order and to first, as with one finger.
                gained = sum(map(mul, found.gradient, found.move))
                break
        z = found.amplitudes
        if gained:
            z = list(map(add, z, found.changes))
        of_found = [[part * one for one in shape] for part, shape in zip(z, shapes, strict=False)]
        left = max(bins.energy - found.explained - gained, 0.0)
        return Fit(at, z, found.energies, found.information, left, of_found, turns, 0.0, shares, scattered)

    def with_shapes(self, bins: Bins, fit: Fit, noise_energy: float) -> Fit:
        """Return a fit of contacts with a size and a shape, if they are worth it: all of `shape_pieces` at once."""
        return finish(self.shape_pieces(bins, fit, noise_energy))

    def shape_pieces(self, bins: Bins, fit: Fit, noise_energy: float, *, lacking: bool = False) -> Steps[Fit]:
        """Return a fit of contacts with a size and a shape, where points leave more than the field's own error.

        The fit stays as it is unless its contacts get shapes that fingers have, and these leave less than a share of
        what points leave, and explain more than noise. While fingers are `lacking`, to leave less is enough, and
        contacts of a usual size do: no shape explains all, but each leaves the next finger clearer.
        """
        signal, left, count = bins.energy - noise_energy, fit.residual_energy - noise_energy, len(fit.positions_mm)
        above = CRITERIA.lone_shape_above if count == 1 else CRITERIA.shape_above
        if not count or signal < CRITERIA.faint * noise_energy or left <= above * signal:
            return fit
        worth = 1.0 if lacking else CRITERIA.lone_shape_worth if count == 1 else CRITERIA.shape_worth
        start, steps = fit, _SIZE_STEPS if lacking else _SHAPE_STEPS
        for usual in (TYPICAL, LARGE):
            if usual is TYPICAL or (lacking and start.residual_energy - noise_energy > CRITERIA.large_above * signal):
                sized = self.fit_known(bins, fit.positions_mm, steps, [usual] * count)
                yield float(count * steps)
                start = min(start, sized, key=lambda one: one.residual_energy)
        missing = lacking and start.residual_energy - noise_energy > CRITERIA.missing * signal
        shaped = start if missing else (yield from self._shape_pieces(bins, start, noise_energy, _SHAPE_STEPS))
        if not shaped.positions_mm and lacking:
            shaped = start
        limit = worth * left - CRITERIA.shape_noise * noise_energy / len(bins.vector)
        if not shaped.shapes or not shaped.residual_energy - noise_energy < limit:
            return fit
        return replace(shaped, points_energy=start.residual_energy)

    def fit_known(
        self, bins: Bins, positions_mm: Sequence[Position], steps: int, shapes: Sequence[Shape],
        turns: Sequence[complex] = (), shares: Sequence[float] = (),
    ) -> Fit:  # fmt: skip
        """Fit contacts of known shapes from positions nearby."""
        if len(positions_mm) == 1:
            x_mm, y_mm = positions_mm[0]
            return self.fit_one(bins, x_mm, y_mm, steps, shapes[0], turns, shares)
        return self.fit_several(bins, positions_mm, steps, _STILL_TOGETHER_MM, shapes, turns, shares)

    def fit_shapes(self, bins: Bins, fit: Fit, noise_energy: float, steps: int) -> Fit:
        """Fit contacts with a size and a shape from those of a fit; no fit if a shape is none that a finger has."""
        return finish(self._shape_pieces(bins, fit, noise_energy, steps))

    def _shape_pieces(self, bins: Bins, fit: Fit, noise_energy: float, steps: int) -> Steps[Fit]:
        variance = noise_energy / len(bins.vector)
        shaped = yield from self._contacts.pieces(bins, fit.positions_mm, variance, steps, fit.residual_energy)
        moved_mm = max(map(math.dist, shaped.positions_mm, fit.positions_mm))
        is_finger = moved_mm < CRITERIA.merged_mm and size_mm2(shaped) < CRITERIA.most_size_mm2
        return shaped if is_finger else no_fit(bins.energy)

    def _products(
        self, positions_mm: Sequence[Position], shapes: Sequence[Shape], sizes: Sequence[float] = ()
    ) -> tuple[list[Position], joint.Products]:
        """Return the raster points, and the products of the fingers' fields and slopes, as `joint.step` takes them."""
        count = len(positions_mm)
        length = 3 * count + 1
        if length > len(self._many):
            self._many = np.zeros((length, len(self._known)), self._known.dtype)
        rows = self._many[:length]
        self._look_ups += count
        at = []
        for k, position in enumerate(positions_mm):
            at.append(self._look_up(*position, shapes[k] if shapes else None, sizes[k] if sizes else 1.0))
            rows[k] = self._value.reshape(-1)
            slope = count + 2 * k
            rows[slope : slope + 2] = self._field[1:]
        rows[-1] = self._known
        halves = rows.reshape(2 * length, -1)
        parts = (halves[:-2] @ halves.T).reshape(length - 1, 2, length, 2)
        table = np.empty((length - 1, length), np.complex128)
        np.add(parts[:, 0, :, 0], parts[:, 1, :, 1], table.real)
        np.subtract(parts[:, 0, :, 1], parts[:, 1, :, 0], table.imag)
        return at, table

    @property
    def spent(self) -> float:
        """Cost of all fits so far, in look-ups."""
        return self._look_ups + SHAPE_COST * self._contacts.steps

    def shift(self, bins: Bins, fit: Fit) -> tuple[Array, Matrix]:
        """Return the matrix from a small change of the bins to that of one finger's x and y, mm, (2, size).

        And the information on such a change, as in a fit: the finger's shape stays as it is.
        """
        self._load(bins)
        z, shapes = fit.amplitudes[0], shapes_of(fit)
        self._look_up(*fit.positions_mm[0], shapes[0] if shapes else None, sizes_of([z], fit.turns)[0])
        real, imaginary = self._field.reshape(3, 2, -1).swapaxes(0, 1)
        u, u_x, u_y = real + _I * imaginary
        parts = [z * (along - u * (np.vdot(u, along) / np.vdot(u, u))) for along in (u_x, u_y)]
        slope = np.stack([part.reshape(self._channels, self._bins) for part in parts])
        rows = np.stack([slope.real, slope.imag], axis=2).reshape(2, -1)
        information = rows @ rows.T
        return np.linalg.solve(information, rows), information.tolist()

    def residual(self, bins: Bins, fit: Fit, shapes: Sequence[Shape] = (), *, without: int | None = None) -> Array:
        """Return what a fit leaves of the bins, shape (channels * 2 * bins,); valid until the next call.

        `shapes` are the fit's, if they are known: their tables are kept. One finger of the fit may be left out.
        """
        self._load(bins if fit.scattered is None else bins.without(fit.scattered))
        if bins is not self._parted[0] or fit is not self._parted[1]:
            self._parted = bins, fit
            self._part_by_finger(fit, shapes or shapes_of(fit) or [None] * len(fit.positions_mm))
        left = self._left
        left[...] = self._value_known
        for k in range(len(fit.positions_mm)):
            if k != without:
                np.subtract(left, self._parts[k], left)
        left.take(self._back, None, self._residual, "wrap")
        return self._residual

    def _part_by_finger(self, fit: Fit, shapes: Sequence[Shape | None]) -> None:
        """Put each finger's part of the bins into `_parts`."""
        if len(shapes) > len(self._parts):
            self._parts = np.zeros((len(shapes), *self._left.shape), self._left.dtype)
        turn = self._turn
        amplitudes = fit.amplitudes
        each = zip(fit.positions_mm, amplitudes, shapes, sizes_of(amplitudes, fit.turns), self._parts, strict=False)
        for (x, y), amplitude, shape, size, part in each:
            self._look_up(x, y, shape, size)
            turn[0, 0] = turn[1, 1] = amplitude.real
            turn[1, 0], turn[0, 1] = amplitude.imag, -amplitude.imag
            turn.dot(self._value, part)

    def _load(self, bins: Bins) -> None:
        """Copy the bins beside the field, in the solver's order, unless they are there."""
        if bins is self._loaded:
            return
        self._loaded = bins
        bins.vector.take(self._order, 0, self._known, "wrap")  # in this mode it needs no copy
        if bins.mask is not self._mask:
            self._mask = bins.mask
            self._ordered_mask = None if bins.mask is None else bins.mask[self._order]

    def _look_up(self, x_mm: float, y_mm: float, shape: Shape | None = None, size: float = 1.0) -> Position:
        """Evaluate the masked field and its derivatives (per mm) into `_field`, and return the raster point."""
        at_shape = self._contact_field.of_shape
        position = self._spline.at(x_mm, y_mm, size) if shape is None else at_shape(x_mm, y_mm, shape, size)
        if self._ordered_mask is not None:
            np.multiply(self._field, self._ordered_mask, self._field)
        return position
