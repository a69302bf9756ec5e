"""How errors grow as a frame gets worse: the field atlas, the network alone, the paper's recipe, kNN and GCC."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchd.config.schema import ModelSettings
from touchd.evaluation.dataset import Dataset, make_dataset
from touchd.evaluation.matching import match_frames
from touchd.evaluation.model_scores import judge
from touchd.evaluation.single_frames import find_with, see, touched_frames
from touchd.lab.reproduction.experiments import dictionary
from touchd.localization.atlas import Atlas
from touchd.localization.model import Model
from touchd.recording.data import Recording
from touchd.twin.electronics import Dead, Electronics
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import simulate_touches

SEED = 7300
"""Of touches that no training saw; each point of each curve has the next one."""


@dataclass(frozen=True, slots=True)
class Answer:
    """What one way of placing fingers said of n touches."""

    error_mm: NDArray[np.float64]
    """Distance from the truth of each touch that was placed, shape (m,)."""
    touches: int
    extra: int = 0
    """Contacts beyond one a touch."""

    @property
    def placed(self) -> float:
        """Share of the touches that were placed at all."""
        return len(self.error_mm) / self.touches

    def percentile_mm(self, percent: float) -> float:
        """NaN if fewer than a twentieth of the touches were placed: of so few nothing can be said."""
        return float(np.percentile(self.error_mm, percent)) if self.placed >= 0.05 else float("nan")


Contender = Callable[[Recording, Dataset], Answer]


def _distance(place_mm: NDArray[np.floating], true_mm: NDArray[np.floating]) -> NDArray[np.float64]:
    return np.asarray(np.linalg.norm(place_mm.astype(np.float64) - true_mm, axis=1))


def by_atlas(model: Model, atlas: Atlas) -> Contender:
    """The field atlas from the network's answer on, each touch as a finger that has just come down."""

    def answer(recording: Recording, _data: Dataset) -> Answer:
        frames = touched_frames(recording)
        seen = match_frames(see(find_with(model, atlas, frames), frames), reach_mm=float("inf"))
        extra = int(np.maximum(seen.contacts - 1, 0).sum())
        return Answer(seen.judged.distance_mm, len(frames), extra)

    return answer


def by_network(model: Model, *, refuses: bool = True) -> Contender:
    """A network by itself; one that knows its confidence places only what the daemon would place."""
    settings = ModelSettings()

    def answer(_recording: Recording, data: Dataset) -> Answer:
        features = data.residual if model.description.input == "residual" else data.signal
        said = judge(model, features, data.position_mm, data.noise_energy)
        sure = (said.confidence >= settings.min_confidence) & (said.sigma_mm <= settings.max_sigma_mm)
        return Answer(said.distance_mm[sure] if refuses else said.distance_mm, len(sure))

    return answer


def by_dictionary(data: Dataset, rows: NDArray[np.int64], method: str) -> Contender:
    """kNN (k = 1) or GCC among the recorded touches of some rows, on residuals."""
    kept = dictionary(data, data.residual, rows, method)

    def answer(_recording: Recording, asked: Dataset) -> Answer:
        return Answer(_distance(kept.locate(asked.residual), asked.position_mm), len(asked))

    return answer


@dataclass(frozen=True, slots=True)
class Axis:
    """What is made worse, step by step."""

    name: str
    label: str
    title: str
    values: tuple[float | str, ...]
    touches: Callable[[float | str, int, int, Instrument], Recording]
    """Takes value, count and seed."""
    logarithmic: bool = False


def _electronics(make: Callable[[float], Electronics]) -> Callable[[float | str, int, int, Instrument], Recording]:
    def touches(value: float | str, count: int, seed: int, instrument: Instrument) -> Recording:
        return simulate_touches(count, seed=seed, instrument=instrument, electronics=make(float(value)))

    return touches


def _dead(value: float | str, count: int, seed: int, instrument: Instrument) -> Recording:
    dead = () if value == "none" else tuple(Dead(int(r)) for r in str(value).split("+"))
    return simulate_touches(count, seed=seed, instrument=instrument, electronics=Electronics(dead=dead))


def _warmer(value: float | str, count: int, seed: int, instrument: Instrument) -> Recording:
    return simulate_touches(count, seed=seed, instrument=instrument, warmer_k=float(value))


def _stale(value: float | str, count: int, seed: int, instrument: Instrument) -> Recording:
    return simulate_touches(count, seed=seed, instrument=instrument, stale_k=float(value))


AXES = (
    Axis(
        "noise", "noise below the untouched signal (dB)", "error by noise", (80, 70, 60, 50, 40, 30, 20, 10, 0),
        _electronics(lambda level_db: Electronics(noise_db=level_db)),
    ),
    Axis(
        "temperature", "plate above its temperature in training (K)", "error by temperature",
        (-15, -10, -5, -2, 0, 2, 5, 10, 15), _warmer,
    ),
    Axis(
        "stale", "plate above its baseline's temperature (K)", "error by an outdated baseline",
        (0.01, 0.03, 0.1, 0.2, 0.5, 1.0, 2.0), _stale, logarithmic=True,
    ),
    Axis(
        "gain", "gain of channel 0, of that in training", "error by gain",
        (0.25, 0.5, 0.8, 1.0, 1.25, 2.0, 4.0),
        _electronics(lambda gain: Electronics(gains=(gain, 1.0, 1.0, 1.0))), logarithmic=True,
    ),
    Axis(
        "jitter", "standard deviation of the trigger's time (ns)", "error by trigger jitter",
        (0.1, 0.3, 1, 3, 10, 30, 100, 200), _electronics(lambda ns: Electronics(jitter_s=ns * 1e-9)), logarithmic=True,
    ),
    Axis("dead", "channels that are dead", "error by dead channels", ("none", "0", "1", "2", "3", "0+1", "2+3"), _dead),
)  # fmt: skip


def measured(
    axis: Axis, contenders: Mapping[str, Contender], count: int, instrument: Instrument,
    values: Sequence[float | str] | None = None,
) -> list[dict[str, Answer]]:  # fmt: skip
    """What every contender says of the same touches, value by value."""
    rows = []
    for number, value in enumerate(values or axis.values):
        seed = SEED + 100 * [a.name for a in AXES].index(axis.name) + number
        recording = axis.touches(value, count, seed, instrument)
        data = make_dataset(recording, least=1)
        rows.append({name: contender(recording, data) for name, contender in contenders.items()})
    return rows
