"""Run a network alone, as the daemon does: on one thread, with buffers bound once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from touchd.localization.model import _load as open_session  # so that both share the session options

_TYPES = {"tensor(float)": np.float32, "tensor(double)": np.float64}


class BoundNetwork:
    """A network with buffers bound once: fill `inputs`, call, read `outputs`."""

    def __init__(self, path: Path, rows: int = 1) -> None:
        self._session = open_session(path)
        self._binding = self._session.io_binding()
        (given,) = self._session.get_inputs()
        kind = _TYPES[given.type]
        self.inputs: NDArray[np.floating] = np.zeros((1, rows, given.shape[-1])[-len(given.shape) :], kind)
        self._binding.bind_input(given.name, "cpu", 0, kind, self.inputs.shape, self.inputs.ctypes.data)
        self.outputs: dict[str, NDArray[np.floating]] = {}
        for said in self._session.get_outputs():
            buffer = np.zeros((1, *said.shape[1:]), _TYPES[said.type])
            self._binding.bind_output(said.name, "cpu", 0, _TYPES[said.type], buffer.shape, buffer.ctypes.data)
            self.outputs[said.name] = buffer

    def __call__(self) -> None:
        """Run the network once."""
        self._session.run_with_iobinding(self._binding)
