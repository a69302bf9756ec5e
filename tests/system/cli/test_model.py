"""`touchd model`: a model is installed, and the one before it comes back."""

from __future__ import annotations

from pathlib import Path

from tests.command_line import touchd
from touchd.errors import ModelInvalid
from touchd.localization.model import default_model_path

SHIPPED = default_model_path()


def test_twice(tmp_path: Path) -> None:
    """Installing a model that is in use keeps the previous one to go back to."""
    config = tmp_path / "touchd.toml"
    config.write_text(f'[model]\npath = "{tmp_path}/plate.onnx"\n')
    verb = ("--config", config, "model", "--socket", tmp_path / "none")
    for name in ("small", "regression", "regression"):
        ended = touchd(*verb, "install", SHIPPED.with_name(f"{name}.onnx"))
        assert ended.code == 0, ended.err
    (wrong := tmp_path / "wrong.onnx").write_text("no model")
    assert touchd(*verb, "install", wrong).code == ModelInvalid.exit_code
    assert "plate.onnx: small;" in touchd(*verb, "rollback").out
    assert "plate.onnx: best;" in touchd(*verb, "rollback").out
