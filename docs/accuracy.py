"""Measure and draw what docs/accuracy.md shows of the shipped field atlas: some minutes, and the extra `train`.

    python -m docs.accuracy [--keep FOLDER] [PART ...]

Data and pictures go to docs/accuracy/; `make docs` then puts the decisive rows on the page.

Recordings are simulated into a temporary folder, or into one that is kept and used again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from docs import measured
from docs.accuracy_plots import FieldImage, NoiseLevel, draw_field, draw_learning, draw_noise
from touchd.config.schema import ModelSettings, Settings
from touchd.evaluation.cramer_rao import (
    atlas_field,
    median_distance_mm,
    plain_covariance,
    position_covariance,
    recorded_field,
    residual_noise,
    twin_values,
)
from touchd.evaluation.dataset import Split, make_dataset, split
from touchd.evaluation.matching import match_frames
from touchd.evaluation.metrics import position_scores
from touchd.evaluation.model_scores import Judgement
from touchd.evaluation.plots.maps import draw_maps
from touchd.evaluation.plots.session import draw_session
from touchd.evaluation.single_frames import find_with, see, touched_frames
from touchd.localization.atlas import Atlas, AtlasDescription
from touchd.localization.features import band_bins
from touchd.localization.model import Model
from touchd.recording.data import Recording
from touchd.recording.format import read, write
from touchd.service.replay import replay
from touchd.training.data.inspection import degrees_of_freedom
from touchd.training.data.temperature import at_one_temperature
from touchd.training.field.bins import informative
from touchd.training.field.dispersion import dispersion_of
from touchd.training.field.learn import learn_thoroughly
from touchd.training.field.make_atlas import make_atlas, signal_over_noise
from touchd.training.field.regression import touches_of
from touchd.twin.electronics import Electronics
from touchd.twin.instrument import Instrument
from touchd.twin.physics.finger import Contact
from touchd.twin.physics.material import mindlin_wavenumber
from touchd.twin.simulate import DEFAULT_PLATE, meta_of, simulate_scene, simulate_touches

ROOT = Path(__file__).resolve().parent.parent
MODEL = ROOT / "models" / "regression.onnx"
PAGE = ROOT / "docs" / "accuracy.md"

LEVELS_DB = (70.0, 60.0, 50.0, 40.0)
TOUCHES = 1500
MAP_TOUCHES = 6000
SEED = 501
"""Of touches that no training saw."""
FIELD_HZ, FIELD_CHANNEL, FIELD_MM = 75e3, 0, 2.0
SESSION, SESSION_SEED = "cross", 503
LEARNED_FROM = (700, 1000, 1500, 2200, 3200)


@dataclass(frozen=True, slots=True)
class Bench:
    """What all measurements need."""

    folder: Path
    instrument: Instrument
    model: Model
    atlas: Atlas

    def recording(self, name: str, make: Callable[[], Recording]) -> Recording:
        """Return a recording of the folder, made first if it is not there."""
        path = self.folder / f"{name}.npz"
        if not path.exists():
            write(path, make(), compress=False)
        return read(path)

    def touches(self, count: int, noise_db: float, seed: int = SEED) -> Recording:
        """Return touches of the silicone finger at a level of noise."""
        electronics = Electronics(noise_db=noise_db)
        return self.recording(
            f"touches-{count}-{noise_db:g}-{seed}",
            lambda: simulate_touches(count, seed=seed, instrument=self.instrument, electronics=electronics),
        )

    def judge(self, recording: Recording, atlas: Atlas | None = None) -> Judgement:
        """Return what the daemon makes of single touches, each as a touch-down on its own."""
        frames = touched_frames(recording)
        find = find_with(self.model, self.atlas if atlas is None else atlas, frames)
        return match_frames(see(find, frames), reach_mm=float("inf")).judged


def field(bench: Bench) -> None:
    """Draw the field of one bin as it is and as it was learned."""
    d = bench.atlas.description
    plate = d.plate
    x_mm = np.arange(5.0, plate.width_mm - 4.9, FIELD_MM)
    y_mm = np.arange(5.0, plate.height_mm - 4.9, FIELD_MM)
    places = np.stack(np.meshgrid(x_mm, y_mm), axis=-1).reshape(-1, 2)
    wanted = round(FIELD_HZ * d.acquisition.samples / d.acquisition.sample_rate_hz)
    u = atlas_field(bench.atlas, places)
    learned = u.value[:, FIELD_CHANNEL, d.bins.index(wanted)]
    at = band_bins(d.acquisition).tolist().index(wanted)
    contacts = [Contact(x, y, 20.0, "silicone") for x, y in places.tolist()]
    blocks = [contacts[i : i + 500] for i in range(0, len(contacts), 500)]
    true = np.concatenate([twin_values(bench.instrument, some, d.taper)[:, FIELD_CHANNEL, at] for some in blocks])
    learned = learned * (learned.conj() @ true) / np.square(np.abs(learned)).sum()
    frequency_hz = wanted * d.acquisition.sample_rate_hz / d.acquisition.samples
    shape = len(y_mm), len(x_mm)
    image = FieldImage(
        x_mm, y_mm, true.reshape(shape), learned.reshape(shape), frequency_hz,
        float(mindlin_wavenumber(plate, frequency_hz)) * 1e-3, FIELD_CHANNEL,
    )  # fmt: skip
    measured.picture(PAGE, draw_field(image, meta_of(bench.instrument, 125, "")), "field")


def maps(bench: Bench) -> None:
    """Draw where on the plate the atlas errs, and which way."""
    recording = bench.touches(MAP_TOUCHES, 60.0, SEED + 1)
    judged = bench.judge(recording)
    measured.picture(PAGE, draw_maps(judged, recording.meta), "maps")


def noise(bench: Bench) -> None:
    """Measure error, bound and standard error by noise."""
    levels, rows = [], []
    for noise_db in LEVELS_DB:
        recording = bench.touches(TOUCHES, noise_db)
        judged = bench.judge(recording)
        u = recorded_field(recording, bench.instrument, bench.atlas.description.taper)
        deviation, a = residual_noise(recording), recording.acquisition
        bound, plain = (median_distance_mm(part(u, a, deviation)) for part in (position_covariance, plain_covariance))
        levels.append(NoiseLevel(noise_db, judged, bound, plain))
        scores = position_scores(judged.error_mm)
        within = [float((np.abs(judged.error_mm) <= k * judged.sigma_mm[:, None]).mean()) for k in (1, 2)]
        rows.append((
            f"{noise_db:g}", f"{scores['rmse_mm']:.3f}", f"{scores['median_mm']:.3f}", f"{scores['p95_mm']:.3f}",
            f"{bound:.4f}", f"{scores['median_mm'] / bound:.1f}", f"{plain:.4f}", f"{within[0]:.0%}",
            f"{within[1]:.0%}", f"{len(judged.error_mm)} of {TOUCHES}",
        ))  # fmt: skip
    headings = (
        "noise_db", "rmse_mm", "median_mm", "p95_mm", "bound_mm", "median_by_bound", "field_known_mm",
        "within_1_sigma", "within_2_sigma", "placed",
    )  # fmt: skip
    measured.data(PAGE, "noise", headings, rows)
    measured.picture(PAGE, draw_noise(levels), "noise")


def session(bench: Bench) -> None:
    """Draw two fingers, followed by the whole pipeline."""
    path = bench.folder / f"{SESSION}-{SESSION_SEED}.npz"
    bench.recording(path.stem, lambda: simulate_scene(SESSION, seed=SESSION_SEED, instrument=bench.instrument))
    outcome = replay(path, Settings(model=ModelSettings(path=MODEL)))
    draw_session(read(path), outcome.touches, PAGE.with_suffix("") / "session.png")


def freedom_of(d: AtlasDescription) -> float:
    """Return the field's degrees of freedom in an atlas' rectangle, which was touched."""
    wavenumber_per_mm = 1e-3 * float(mindlin_wavenumber(d.plate, d.acquisition.chirp.stop_hz))
    return degrees_of_freedom(np.array([d.low_mm, d.high_mm]), wavenumber_per_mm)


def learning(bench: Bench) -> None:
    """Measure the error by the number of training touches; `touchd train` learned the shipped atlas from the most."""
    recording = simulate_touches(6404, seed=1, even=True, instrument=bench.instrument)
    steady, reference = at_one_temperature(recording, make_dataset(recording, taper=bench.atlas.description.taper))
    parts = split(len(steady), 0)
    wavenumber = dispersion_of(steady, touches_of(steady, parts.train))
    snr = signal_over_noise(touches_of(steady, parts.validation))
    kept = informative(snr, wavenumber, bench.atlas.description.acquisition)
    test = bench.touches(TOUCHES, 60.0)
    atlases = {}
    for count in LEARNED_FROM:
        some = Split(parts.train[:count], parts.validation, parts.test)
        learned = learn_thoroughly(touches_of(steady, some.train), wavenumber)
        atlases[count] = make_atlas(steady, reference, some, learned, kept, {})[0]
    atlases[bench.atlas.description.touches] = bench.atlas
    scores = [position_scores(bench.judge(test, atlas).error_mm) for atlas in atlases.values()]
    freedom = freedom_of(bench.atlas.description)
    rows = [
        (n, f"{s['rmse_mm']:.3f}", f"{s['median_mm']:.3f}", f"{s['p95_mm']:.3f}")
        for n, s in zip(atlases, scores, strict=True)
    ]
    measured.data(PAGE, "learning", ("training_touches", "rmse_mm", "median_mm", "p95_mm"), rows)
    measured.picture(PAGE, draw_learning(list(atlases), scores, freedom), "learning")


PARTS = {part.__name__: part for part in (field, maps, noise, session, learning)}


def main() -> None:
    """Make the parts that are asked for, by default all."""
    with measured.asked(PAGE, __doc__ or "", PARTS, "the recordings") as (folder, wanted):
        model = Model(MODEL)
        assert model.atlas is not None
        bench = Bench(folder, Instrument(DEFAULT_PLATE), model, model.atlas)
        for name, part in wanted.items():
            part(bench)
            print(f"{name}: done")


if __name__ == "__main__":
    main()
