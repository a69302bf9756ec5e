"""The field of a contact that is as wide as a finger."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import numpy as np
import pytest
from scipy.integrate import dblquad

from tests.unit.calibration.plates import PLATE
from touchd.calibration.plate_fit import PlateFit
from touchd.calibration.soft_face import FACE_MM, for_fingers, spread
from touchd.localization.atlas import Atlas
from touchd.training.field.place import FieldMap


@pytest.fixture(scope="module")
def wide(atlas: Atlas) -> Atlas:
    return spread(atlas)


def test_it_is_the_mean_over_the_face(atlas: Atlas, wide: Atlas) -> None:
    """Inside the plate: of the small contact's field, weighed by Gauss' bell."""
    small, large = FieldMap(atlas), FieldMap(wide)
    for x_mm, y_mm in ((0.5 * PLATE.width_mm, 0.5 * PLATE.height_mm), (22.0, 31.0)):

        def part(dy: float, dx: float, x: float = x_mm, y: float = y_mm) -> float:
            bell = np.exp(-(dx**2 + dy**2) / (2 * FACE_MM**2)) / (2 * np.pi * FACE_MM**2)
            return float(bell * small.at(np.array([[x + dx, y + dy]])).real[0, 1, 5])

        reach = 4.5 * FACE_MM
        exact = dblquad(part, -reach, reach, -reach, reach, epsabs=1e-3, epsrel=1e-4)[0]
        assert large.at(np.array([[x_mm, y_mm]])).real[0, 1, 5] == pytest.approx(exact, rel=0.01)


def test_in_a_corner_a_contact_stays_small(atlas: Atlas, wide: Atlas) -> None:
    """It is as wide as the plate admits, as in the small contact's own field."""
    corners = np.array([[x, y] for x in (0.0, PLATE.width_mm) for y in (0.0, PLATE.height_mm)])
    small, large = FieldMap(atlas).at(corners), FieldMap(wide).at(corners)
    assert np.linalg.norm(large - small) < 0.01 * np.linalg.norm(small)


def test_the_error_stays_its_share_of_the_field(atlas: Atlas, wide: Atlas) -> None:
    def share(of: Atlas) -> np.ndarray:
        nodes = of.coefficients.reshape(-1, len(of.error), 2, of.error.shape[1]).astype(np.float64)
        return cast("np.ndarray", of.error / np.square(nodes).sum(axis=2).mean(axis=0))

    assert share(wide) == pytest.approx(share(atlas), rel=1e-4)
    assert wide.error.mean() < atlas.error.mean()


def test_only_where_waves_are_short(atlas: Atlas, fit: PlateFit) -> None:
    """On 5 mm of glass a fingertip is a point with a shape; on 1 mm of it waves are less than half as long."""
    assert for_fingers(atlas, fit) is atlas
    thin = replace(fit, plate=fit.plate.model_copy(update={"thickness_mm": 1.0}))
    assert for_fingers(atlas, thin).description.face_mm == FACE_MM
