"""Settings come from where they should, and every mistake is named together with what to do about it."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from docs import settings as settings_page
from touchd.config import load as configfile
from touchd.config.load import Retired, load
from touchd.config.render import fields, render, variable
from touchd.config.schema import RETIRED, DeviceSettings, LogSettings, Settings
from touchd.errors import ConfigError

FILE_SETTINGS = hypothesis_settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


pytestmark = pytest.mark.usefixtures("own_settings")


def toml(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "touchd.toml"
    path.write_text(text)
    return path


def mistake(path: Path | None = None, overrides: dict[str, Any] | None = None) -> ConfigError:
    with pytest.raises(ConfigError) as caught:
        load(path, overrides)
    assert caught.value.fix
    return caught.value


class TestPrecedence:
    def test_without_anything_the_defaults_hold(self) -> None:
        assert load() == Settings()

    def test_options_win_over_environment_over_file_over_defaults(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        path = toml(tmp_path, '[device]\nname = "file"\nserial = "file"\nrate_hz = 10\n')
        monkeypatch.setenv("TOUCHD_DEVICE__NAME", "environment")
        monkeypatch.setenv("TOUCHD_DEVICE__SERIAL", "environment")
        found = load(path, {"device": {"name": "option"}}).device
        assert found == DeviceSettings(name="option", serial="environment", rate_hz=10)

    def test_the_default_file_is_read_if_it_exists(self) -> None:
        configfile.DEFAULT_PATH.parent.mkdir()
        configfile.DEFAULT_PATH.write_text("[device]\nrate_hz = 10\n")
        assert load().device.rate_hz == 10

    def test_a_named_file_is_read_instead_of_the_default_file(self, tmp_path: Path) -> None:
        configfile.DEFAULT_PATH.parent.mkdir()
        configfile.DEFAULT_PATH.write_text("[device]\nrate_hz = 10\n")
        assert load(toml(tmp_path, "")) == Settings()

    @pytest.mark.parametrize("text", ["tcp://127.0.0.1:1,ipc:///a", '["tcp://127.0.0.1:1", "ipc:///a"]'])
    def test_a_list_in_the_environment_has_commas_or_is_json(self, monkeypatch: pytest.MonkeyPatch, text: str) -> None:
        monkeypatch.setenv("TOUCHD_BUS__BIND", text)
        assert load().bus.bind == ("tcp://127.0.0.1:1", "ipc:///a")

    def test_an_empty_path_takes_back_what_the_file_set(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        path = toml(tmp_path, '[model]\npath = "a.onnx"\n')
        assert load(path).model.path == Path("a.onnx")
        monkeypatch.setenv("TOUCHD_MODEL__PATH", "")
        assert load(path).model.path is None

    def test_variables_that_are_no_settings_are_left_alone(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("TOUCHD_DEBUG", "1")
        monkeypatch.setenv("TOUCHDOWN__BUS", "1")
        assert load() == Settings()


FILE_MISTAKES = [
    ("[device]\nrate_hz = 0", "device.rate_hz", r"is 0, must be a whole number, 1 to 65535 -> .* the default, 125"),
    ("[device]\nrate_hz = 1.5", "device.rate_hz", r"is 1\.5, must be a whole number"),
    ("[device]\nrate_hz = true", "device.rate_hz", r"is True, must be a whole number"),
    ("[input]\nrotate = 45", "input.rotate", r"is 45, must be a whole number, 0 to 270 and a multiple of 90"),
    ("[tuio]\nto = 'localhost'", "tuio.to", r"must be HOST:PORT, for example 127\.0\.0\.1:3333"),
    ("[device]\nname = ''", "device.name", r"is empty, must be a text, not empty"),
    ("[device]\nname = 5", "device.name", r"is 5, must be a text"),
    ("[device]\nvendor_id = 0x" + "f" * 5000, "device.vendor_id", r"is far too large, must be a whole number"),
    ("[gate]\nfalse_alarm_rate = nan", "gate.false_alarm_rate", r"is nan, must be a number, .* below 0\.1"),
    ("[bus]\ninsecure = 'maybe'", "bus.insecure", r"is 'maybe', must be true or false"),
    ("[bus]\nbind = 'tcp://a:1'", "bus.bind", r"is 'tcp://a:1', must be a list of addresses"),
    ("[bus]\nbind = ['tcp://a:1', 'udp://b']", "bus.bind[1]", r"is 'udp://b', must be an address"),
    ("[log]\nlevel = 'trace'", "log.level", r"is 'trace', must be one of debug, info, warning, error"),
    ("[model]\npath = 3", "model.path", r"is 3, must be a path or empty"),
    ('[model]\npath = "a\\u0000b"', "model.path", r"no name can have"),
    ("bus = 3", "bus", r"is 3, must be a table -> write \[bus\]"),
    ("[[bus]]\ninsecure = true", "bus", r"must be a table"),
    ("[bus]\nbidn = []", "bus.bidn", r"unknown key -> did you mean bus\.bind\?"),
    ("[device]\nbind = []", "device.bind", r"unknown key -> did you mean bus\.bind\?"),
    ("bind = []", "bind", r"unknown table or key -> did you mean bus\.bind\?"),
    ("[trakcer]", "trakcer", r"unknown table or key -> did you mean \[tracker\]\?"),
    ("[zzz]", "zzz", r"unknown table or key -> remove it"),
    ("[Device]\nrate_hz = 10", "Device", r"unknown table or key -> did you mean \[device\]\?"),
]


@pytest.mark.parametrize(
    ("text", "key", "message"), FILE_MISTAKES, ids=[case[1] + case[0][-9:] for case in FILE_MISTAKES]
)
def test_a_mistake_in_the_file_names_file_key_and_remedy(tmp_path: Path, text: str, key: str, message: str) -> None:
    path = toml(tmp_path, text)
    error = mistake(path)
    assert error.where == f"{path}: {key}"
    with pytest.raises(ConfigError, match=message):
        load(path)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("TOUCHD_DEVICE__RATE_HZ", "fast", r"TOUCHD_DEVICE__RATE_HZ: is 'fast', must be a whole number, 1 to 65535"),
        ("TOUCHD_DEVICE__RATE", "1", r"unknown variable -> did you mean TOUCHD_DEVICE__RATE_HZ\?"),
        ("TOUCHD_DEVICE_RATE_HZ", "1", r"unknown variable -> did you mean TOUCHD_DEVICE__RATE_HZ\?"),
        ("TOUCHD_DEBUGG", "1", r"unknown variable -> did you mean TOUCHD_DEBUG\?"),
        ("TOUCHD_NOPE", "1", r"unknown variable -> remove it; `touchd config --default` prints every key"),
        ("TOUCHD_CONFIG", "x.toml", r"unknown variable -> remove it;"),
        ("TOUCHD_LOG", "debug", r"names a whole table -> name one of its keys: TOUCHD_LOG__KEY"),
        ("TOUCHD_DEVICE__VENDOR_ID", "0x12345", r"is '0x12345', must be a whole number, 0 to 65535"),
        ("TOUCHD_BUS__BIND", "[1, 2", r"TOUCHD_BUS__BIND: is '\[1', must be an address"),
        ("TOUCHD_DEVICE__NAME", "\udcff", r"TOUCHD_DEVICE__NAME: is not UTF-8"),
    ],
)
def test_a_mistake_in_the_environment_names_the_variable(
    monkeypatch: pytest.MonkeyPatch, name: str, value: str, message: str
) -> None:
    monkeypatch.setenv(name, value)
    with pytest.raises(ConfigError, match=message):
        load()


def test_a_default_that_does_not_fit_is_to_be_set(tmp_path: Path) -> None:
    """A card of 48 kHz cannot have the band that is the default: nobody is told to leave it out, and one is named."""
    wrong = mistake(toml(tmp_path, "[audio]\nsample_rate_hz = 48000\n"))
    assert (wrong.where, "set it" in wrong.fix) == ("audio.band_hz", True)
    assert "such as 7700, 21100" in wrong.what
    load(toml(tmp_path, "[audio]\nsample_rate_hz = 48000\nband_hz = [7700, 21100]\n"))


def test_a_usb_id_is_set_as_it_is_printed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TOUCHD_DEVICE__VENDOR_ID", "0x1d6b")
    assert load().device.vendor_id == 0x1D6B


def test_a_mistake_on_the_command_line_is_not_blamed_on_the_file(tmp_path: Path) -> None:
    error = mistake(toml(tmp_path, "[device]\nrate_hz = 10"), {"device": {"rate_hz": 0}})
    assert error.where == "command line: device.rate_hz"


def test_a_file_may_have_braces_in_its_name(tmp_path: Path) -> None:
    """Its name stands in the message as it is."""
    path = tmp_path / "{key}.toml"
    path.write_text("[device]\nrate_hz = 0")
    assert mistake(path).where == f"{path}: device.rate_hz"


def test_all_mistakes_are_told_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TOUCHD_LOG__LEVEL", "loud")
    monkeypatch.setenv("TOUCHD_BUSS__BIND", "x")
    error = mistake(toml(tmp_path, "[device]\nrate_hz = 0\nnmae = 'x'"), {"gate": {"noise_frames": 1}})
    assert error.what.startswith("5 problems: ")
    for part in ("TOUCHD_LOG__LEVEL", "TOUCHD_BUSS__BIND", "device.rate_hz", "device.nmae", "gate.noise_frames"):
        assert part in error.what


@pytest.mark.parametrize(
    ("content", "where", "what"),
    [
        (b"[device]\nrate_hz 10\n", "line 2, column 9", "is not valid TOML: expected '='"),
        (b"[device", "end of document", "is not valid TOML"),
        (b"[device]\nname = '\xff'\n", "line 2", "is not UTF-8"),
        (b"a = " + b"[" * 5000, "", "is not valid TOML"),
        (b"a = " + b"1" * 5000, "", "is not valid TOML"),
    ],
)
def test_a_file_that_is_not_toml_says_where(tmp_path: Path, content: bytes, where: str, what: str) -> None:
    path = tmp_path / "touchd.toml"
    path.write_bytes(content)
    error = mistake(path)
    assert error.where.startswith(str(path))
    assert where in error.where
    assert error.what.startswith(what)


def test_a_named_file_must_exist_and_be_readable(tmp_path: Path) -> None:
    assert mistake(tmp_path / "nowhere.toml").what == "no such file"
    assert "cannot be read" in mistake(tmp_path).what


class TestRetired:
    """A key that went is accepted and ignored, and its place is reported with what took over."""

    @pytest.mark.parametrize("name", RETIRED)
    def test_in_file_environment_and_overrides(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
    ) -> None:
        """One report for each place, in order of precedence."""
        table, _, key = name.partition(".")
        path = toml(tmp_path, f"[{table}]\n{key} = 1\n")
        monkeypatch.setenv(variable(table, key), "1")
        reports: list[Retired] = []
        assert load(path, {table: {key: 1}}, reports.append) == Settings()
        places = [f"command line: {name}", f"environment: {variable(table, key)}", f"{path}: {name}"]
        assert reports == [Retired(place, RETIRED[name]) for place in places]

    def test_beside_other_keys(self, tmp_path: Path) -> None:
        """The rest of its table counts, and mistakes there are still mistakes."""
        path = toml(tmp_path, "[realtime]\nnice = 'any'\nawake_from_hz = 0\n")
        assert load(path).realtime.awake_from_hz == 0
        assert mistake(toml(tmp_path, "[realtime]\nnice = 5\nnicer = 5\n")).where == f"{path}: realtime.nicer"

    def test_overrides_stay_as_they_were(self) -> None:
        """The caller may load with them again."""
        overrides = {"realtime": {"nice": 1}}
        load(None, overrides)
        assert overrides == {"realtime": {"nice": 1}}

    def test_none_is_a_key(self) -> None:
        """No key is both retired and in use."""
        assert not RETIRED.keys() & {f"{table}.{key}" for table, key, _ in fields()}


class TestSecrets:
    KEY = "JTKVSB%%)wK0E.X)V>+}o?pNmC{O&4W4b!Ni{Lh6"

    def test_a_key_in_place_of_its_file_is_refused_without_repeating_it(self, tmp_path: Path) -> None:
        error = mistake(toml(tmp_path, f"[bus]\ncurve_secret_key = '{self.KEY}'"))
        assert self.KEY not in str(error)
        assert "path of the file" in str(error)

    def test_a_wrong_value_of_a_secret_key_is_not_repeated(self, tmp_path: Path) -> None:
        assert self.KEY not in str(mistake(toml(tmp_path, f"[bus]\ncurve_secret_key = ['{self.KEY}']")))

    @pytest.mark.parametrize("path", ["/etc/touchd/keys/the-door-downstairs.key", "keys/touchd.key_secret"])
    def test_paths_of_keys_are_accepted(self, tmp_path: Path, path: str) -> None:
        assert load(toml(tmp_path, f"[bus]\ncurve_secret_key = '{path}'")).bus.curve_secret_key == Path(path)


text = st.text(st.characters(codec="utf-8"), max_size=8)
path_text = st.none() | st.text(st.characters(codec="utf-8", exclude_characters="\0"), min_size=1, max_size=8)


@st.composite
def configurations(draw: st.DrawFn) -> Settings:
    return Settings.model_validate(
        {
            "device": {"name": draw(text.filter(bool)), "serial": draw(text), "rate_hz": draw(st.integers(1, 65535))},
            "model": {"path": draw(path_text), "min_confidence": draw(st.floats(0, 1))},
            "gate": {"false_alarm_rate": draw(st.floats(1e-15, 0.09))},
            "tracker": {"reach_mm": draw(st.floats(0.1, 1000))},
            "bus": {
                "bind": draw(st.lists(st.builds("ipc://{}".format, st.text("ab /\"'\\é", min_size=1)), min_size=1)),
                "insecure": draw(st.booleans()),
            },
            "log": {"format": draw(st.sampled_from(["auto", "console", "json"]))},
        }
    )


class TestRender:
    @hypothesis_settings(FILE_SETTINGS, max_examples=25)
    @given(configured=configurations())
    def test_what_is_rendered_loads_as_the_same_settings(self, tmp_path: Path, configured: Settings) -> None:
        path = tmp_path / "rendered.toml"
        path.write_bytes(render(configured).encode())
        assert load(path) == configured

    def test_every_key_is_there_with_its_meaning_default_and_range(self) -> None:
        rendered = render(Settings(log=LogSettings(level="error")))
        parsed = tomllib.loads(rendered)
        for table, key, field in fields():
            assert key in parsed[table]
            assert field.description, f"{table}.{key} says nothing about itself"
            assert f"# {field.description}" in rendered
        assert '# One of debug, info, warning, error. Default: "info"\nlevel = "error"\n' in rendered
        assert "# A whole number, 1 to 65535. Default: 125\nrate_hz = 125\n" in rendered

    def test_the_reference_has_a_line_for_every_key(self) -> None:
        reference = settings_page.page()
        for table, key, field in fields():
            section = reference.split(f"\n## `[{table}]`\n")[1].split("\n## ")[0]
            (line,) = (line for line in section.splitlines() if line.startswith(f"- `{key}` ("))
            assert line.endswith(f"): {field.description}")
        assert f"`{variable('device', 'rate_hz')}=500`" in reference
        assert "- `rate_hz` (`125`): " in reference


def assert_settings_or_config_error(path: Path) -> None:
    refusal = None
    try:
        found = load(path)
    except ConfigError as error:
        refusal = error
    else:
        assert isinstance(found, Settings)
    assert refusal is None or (refusal.what and refusal.where and refusal.fix and str(refusal))


JSON = st.recursive(
    st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)
TABLES = st.sampled_from([*Settings.model_fields, "buss", ""])
KEYS = st.sampled_from(sorted({key for _, key, _ in fields()})) | st.text(max_size=4)


@FILE_SETTINGS
@given(tables=st.dictionaries(TABLES, st.dictionaries(KEYS, JSON, max_size=4) | JSON, max_size=3))
def test_any_content_gives_settings_or_a_config_error(tables: dict[str, Any]) -> None:
    refusal = None
    try:
        load(None, tables)
    except ConfigError as error:
        refusal = error
    assert refusal is None or (refusal.where and refusal.fix and str(refusal))


@FILE_SETTINGS
@given(content=st.binary(max_size=60) | st.text("[]=\"'\n#.{}ab1e_ ,tr", max_size=60).map(str.encode))
def test_any_file_gives_settings_or_a_config_error(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "touchd.toml"
    path.write_bytes(content)
    assert_settings_or_config_error(path)


@FILE_SETTINGS
@given(data=st.data())
def test_a_spoiled_file_gives_settings_or_a_config_error(tmp_path: Path, data: st.DataObject) -> None:
    content = bytearray(render(Settings()).encode())
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.sampled_from(b"\"'[]=.\n#0aZ\xff"))
    path = tmp_path / "touchd.toml"
    path.write_bytes(content)
    assert_settings_or_config_error(path)


@FILE_SETTINGS
@given(name=st.sampled_from([variable(table, key) for table, key, _ in fields()]), value=JSON.map(json.dumps) | text)
def test_any_variable_gives_settings_or_a_config_error(tmp_path: Path, name: str, value: str) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(name, value.replace("\0", ""))
        assert_settings_or_config_error(toml(tmp_path, ""))
