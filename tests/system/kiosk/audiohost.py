"""What the machine's audio interface hears, computed beforehand: the plate at 48 kHz, its model, ten fingers.

`python -m tests.system.kiosk.audiohost FOLDER` writes it there, `places.json` last. The rate is one that an emulated
processor keeps up with.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from touchd.audio.card import loop_of
from touchd.calibration.calibrate import fit_recording, make_model
from touchd.calibration.plate_file import read_plate_file
from touchd.config.rigs import AudioSettings
from touchd.frame import Acquisition
from touchd.sources.audio import acquisition_of
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.finger import Contact
from touchd.twin.scenes.catalogue import stage_scene
from touchd.twin.simulate import DEFAULT_PLATE, simulate_stage

FRAMES_HZ = 25
SETTINGS = AudioSettings(device="hw:CARD=Loopback,DEV=0", sample_rate_hz=48_000, band_hz=(5e3, 20e3), chirp_s=4e-3)
PLACES_MM = [[x, y] for y in (50.0, 130.0) for x in (40.0, 70.0, 100.0, 130.0, 160.0)]
PEAK, NOISE = 8000.0, 4.0
SAID = """
[plate]
width_mm = 200
height_mm = 200
thickness_mm = 5.0
material = "glass"
[discs]
diameter_mm = 6
emitter_mm = [30, 100]
receivers_mm = [[15, 15], [185, 20], [180, 185], [20, 170]]
"""


def write(folder: Path) -> None:
    """Write the model, and the responses from what is played to what is heard, for `audioplate.py`."""
    os.nice(10)
    acquisition = acquisition_of(SETTINGS)
    instrument = Instrument(DEFAULT_PLATE, acquisition=acquisition)
    idle = simulate_stage(stage_scene("idle", DEFAULT_PLATE, rate_hz=25, frames=60), instrument, 0)
    (folder / "PLATE.toml").write_text(SAID)
    make_model(fit_recording(idle, read_plate_file(folder / "PLATE.toml")), folder / "audio.onnx")
    fingers = [[Contact(x, y, 100.0, "fingertip")] for x, y in PLACES_MM]
    heard = responses(SETTINGS, acquisition, fingers)
    np.savez(folder / "audio.npz", responses=heard, rate_hz=SETTINGS.sample_rate_hz, noise=NOISE)
    (folder / "places.json").write_text(json.dumps(PLACES_MM))


def responses(settings: AudioSettings, acquisition: Acquisition, touches: list[list[Contact]]) -> NDArray[np.float32]:
    """Impulse responses without a touch and under each, shape (1 + touches, channels, taps)."""
    period = settings.sample_rate_hz // FRAMES_HZ
    once = acquisition.chirp.model_copy(update={"period_s": None})
    whole = Instrument(DEFAULT_PLATE, acquisition=acquisition.model_copy(update={"samples": period, "chirp": once}))
    untouched = whole.untouched([REFERENCE_C])
    heard = np.concatenate([untouched, untouched + whole.change(touches, [REFERENCE_C] * len(touches))])
    loop = loop_of(acquisition.chirp, settings.sample_rate_hz, period, settings.level_dbfs)
    size = 2 * period
    played = np.fft.rfft(loop, size)
    power = np.abs(played) ** 2
    spectra = np.fft.rfft(heard, size) * np.conj(played) / (power + 1e-4 * power.max())
    return np.asarray(PEAK / 2**15 * np.fft.irfft(spectra, size)[..., :period], np.float32)


if __name__ == "__main__":
    write(Path(sys.argv[1]))
