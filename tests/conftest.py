"""Signals and threads as every test expects them; models, scenes and touches of the twin that many tests share."""

# ruff: noqa: E402 - the environment has to be set before anything imports numpy

from __future__ import annotations

import fcntl
import gc
import os
import signal
import sys
import tempfile

# A shell makes what it runs in the background ignore Ctrl-C, and nohup SIGHUP: every process that a test starts would
# inherit that. A handler is not inherited; this one ignores the signal for this process as before.
for _number in (signal.SIGHUP, signal.SIGQUIT, signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, lambda _number, _frame: None)
signal.signal(signal.SIGINT, signal.default_int_handler)
# Before numpy is imported, and inherited by every process that a test starts: two busy threads of BLAS on two busy
# cores wait for each other for milliseconds.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"
# Some environments say so to keep folders clean: each process that a test starts would then compile touchd, which takes
# as long as all its imports.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# So that no test takes a model that is installed on this computer, or leaves pre-rolls where a person's are.
_state = tempfile.TemporaryDirectory(prefix="touchd-state-")
os.environ["STATE_DIRECTORY"] = _state.name

# To import all that tests use makes no garbage to speak of, but millions of objects to look through again and again.
gc.disable()

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
import structlog
from hypothesis import HealthCheck, settings

from touchd.evaluation.dataset import Dataset, make_dataset
from touchd.localization.model import Model, default_model_path
from touchd.recording.data import Recording
from touchd.recording.format import read, write
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import DEFAULT_PLATE, simulate_scene, simulate_touches

if TYPE_CHECKING:
    from touchd.training.field.learn import Field

# How long an example takes is the computer's affair. Each run tries the same examples, so that no change is held up by
# what it did not break; "random" looks for more: make random.
settings.register_profile("random", deadline=None, suppress_health_check=[HealthCheck.too_slow], print_blob=True)
settings.register_profile("touchd", settings.get_profile("random"), derandomize=True, max_examples=50)
settings.register_profile("quick", settings.get_profile("touchd"), max_examples=25)  # for the inner loop: make unit
settings.load_profile("touchd")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add how long the hostile tests go on: seconds for each change, or minutes before a release."""
    parser.addoption("--hostile", choices=["short", "full"], default="short")


FIRST = (
    "system/web/test_calibrate", "system/web/test_page", "scenes/test_ghosts", "scenes/test_scenes",
    "system/hostile/test_bus", "scenes/test_calibration", "system/deploy/test_systemd", "system/web/test_server",
)  # fmt: skip
"""Files that take longest. Some wait, some compute: side by side they leave no processor idle, nor one at the end."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run the longest files first; the others stay in the order of pyproject's `testpaths`."""
    tests = Path(__file__).parent
    order = {tests / f"{name}.py": number for number, name in enumerate(FIRST)}
    items.sort(key=lambda item: order.get(item.path, len(order)))


def pytest_collection_finish() -> None:
    """Collect garbage again once the tests are imported, but of what comes later."""
    gc.freeze()
    gc.enable()


Scene = Callable[[str], Recording]
TOUCHES = 400
KNOWN = 300
"""Touches that are learned from; the others are held out."""


@pytest.fixture(autouse=True)
def fresh_log() -> Iterator[None]:
    """No test leaves its log's stream behind, which may be closed by then."""
    yield
    structlog.reset_defaults()


@pytest.fixture
def own_settings(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """No setting comes from the environment, or from this computer's file."""
    for name in list(os.environ):
        if name.upper().startswith("TOUCHD_"):
            monkeypatch.delenv(name)
    monkeypatch.setattr("touchd.config.load.DEFAULT_PATH", tmp_path / "etc" / "touchd.toml")


@pytest.fixture(scope="session")
def model() -> Model:
    """The shipped network, alone."""
    return Model(default_model_path(), atlas=False)


@pytest.fixture(scope="session")
def atlas_model() -> Model:
    """The shipped network with its field atlas."""
    model = Model(default_model_path())
    assert model.atlas is not None
    return model


@pytest.fixture(scope="session")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of this run, that all of its processes have."""
    own = tmp_path_factory.getbasetemp()
    return own.parent if "PYTEST_XDIST_WORKER" in os.environ else own


@contextmanager
def alone(path: Path) -> Iterator[None]:
    """Let one of the tests' processes at a time go on."""
    with path.open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@pytest.fixture(scope="session")
def instrument(shared: Path) -> Instrument:
    """The default plate; of the tests' processes one solves its modes, where they are not on disk yet."""
    with alone(shared / "modes.lock"):
        return Instrument(DEFAULT_PLATE)


@pytest.fixture(scope="session")
def scene_file(instrument: Instrument, shared: Path) -> Callable[[str], Path]:
    """A scene of the twin as a file, computed once: by one of the tests' processes."""

    def path_of(name: str) -> Path:
        path = shared / f"scene-{name}.npz"
        with alone(path.with_suffix(".lock")):
            if not path.exists():
                write(path, simulate_scene(name, seed=21, instrument=instrument), compress=False)
        return path

    return path_of


@pytest.fixture(scope="session")
def scene(scene_file: Callable[[str], Path]) -> Scene:
    """A scene of the twin by its name."""
    return cache(lambda name: read(scene_file(name)))


@pytest.fixture(scope="session")
def touches(instrument: Instrument) -> Recording:
    """A small robot's training set: the middle alone, where so few lie as close as thousands do on the whole plate."""
    return simulate_touches(TOUCHES, seed=3, instrument=instrument, margin_mm=70.0)


@pytest.fixture(scope="session")
def dataset(touches: Recording) -> Dataset:
    """Its touches, less the untouched plate."""
    return make_dataset(touches)


@pytest.fixture(scope="session")
def field(dataset: Dataset) -> Field:
    """What is learned from the known ones; imported here, since scipy takes half a second."""
    from touchd.training.field.few_touches import learn_field

    return learn_field(dataset, np.arange(KNOWN))
