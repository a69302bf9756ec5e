"""What places fingers in a single frame: a network by itself, or with the field atlas that lies beside it."""

from __future__ import annotations

from collections.abc import Sequence
from math import nan, sqrt

import numpy as np
from numpy.typing import NDArray

from touchd.config.schema import ModelSettings, TrackerSettings
from touchd.evaluation.single_frames import Find, Look, TouchedFrames
from touchd.localization.atlas import Atlas
from touchd.localization.atlas_localizer import Locator
from touchd.localization.features import Features, make_features, noise_to_signal
from touchd.localization.model import Estimate, Model
from touchd.localization.noise_power import MEMORY_FRAMES
from touchd.touch import Touch

Array = NDArray[np.float32]


def finder_of(model: Model, frames: TouchedFrames) -> Find:
    """Return what the daemon places fingers with: the field atlas of a model if it has one, else its network."""
    return network_finder(model, frames) if model.atlas is None else atlas_finder(model, model.atlas, frames)


def network_finder(model: Model, frames: TouchedFrames) -> Find:
    """Return the finder that a network is: one touch, always, as it knows nothing but single fingers.

    Its force is the length of the residual's features against the untouched plate's, on the daemon's default scale;
    unknown (NaN) for a network that does not take the residual.
    """
    of_residual = model.description.input == "residual"
    route = _route(model, frames)
    extract = route.extract
    noise_energy = frames.noise_energy()
    plain = np.empty_like(model.features[0])
    lengths = []
    for i in range(len(frames)):
        extract(frames.baseline(i), plain)
        lengths.append(float(np.linalg.norm(plain)))
    full = float(np.median(lengths)) * TrackerSettings().force_full_scale

    def find(look: Look) -> Sequence[Touch]:
        features = model.features[0]
        extract(_input(model, look), features)
        force = min(1.0, float(np.linalg.norm(features)) / full) if of_residual and full else nan
        said = model.estimate()
        sigma_mm = said.error_mm(noise_to_signal(route, noise_energy, float(features @ features)))
        return (Touch(said.x_mm, said.y_mm, sigma_mm, said.confidence, force, said.key),)

    return find


def atlas_finder(model: Model, atlas: Atlas, frames: TouchedFrames) -> Find:
    """Return the finder that a field atlas is with its network, with the daemon's settings: each frame is a touch-down.

    The baseline is that of the frame, the mean of two untouched ones, so a residual has the noise of one and a half
    frames. It is heard from the difference of those two, which has that of two.
    """
    locator, settings = Locator(atlas), ModelSettings()
    for i in np.linspace(0, len(frames) - 1, min(len(frames), MEMORY_FRAMES)).astype(int).tolist():
        one, other = frames.counts[frames.beside[i]].astype(np.float32)
        if (one != other).any():
            locator.rebase(frames.baseline(i))
            locator.hear((one - other) * np.float32(sqrt(3) / 2))
    extract = _route(model, frames).extract

    def find(look: Look) -> Sequence[Touch]:
        def start() -> Estimate:
            extract(_input(model, look), model.features[0])
            return model.estimate()

        locator.forget()
        locator.rebase(look.baseline)
        found = locator.locate(look.residual, 0.0, settings.min_confidence, start)
        return [touch for touch in found if touch.sigma_mm <= settings.max_sigma_mm]

    return find


def network_features(model: Model, frames: TouchedFrames) -> Array:
    """Return what a network takes of each frame, shape (n, inputs)."""
    extract = _route(model, frames).extract
    features = np.empty((len(frames), model.description.inputs), np.float32)
    for i, row in enumerate(features):
        extract(_input(model, frames.look(i)), row)
    return features


def _route(model: Model, frames: TouchedFrames) -> Features:
    return make_features(model.description.domain, frames.acquisition)


def _input(model: Model, look: Look) -> Array:
    return look.residual if model.description.input == "residual" else look.counts.astype(np.float32)
