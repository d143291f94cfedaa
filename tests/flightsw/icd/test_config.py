"""Files that a person writes are read strictly: what is wrong is named by file and key."""

import json
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from flightsw.icd.config import ConfigError, parse_json, parse_yaml
from flightsw.icd.mission import load_mission
from flightsw.icd.telemetry import parse_dictionary
from ground.formats.nerf import load_transforms
from ground.formats.pictures.views import FormatError
from ground.session.folder import SessionCorrupt, open_session
from hil.dataset import DATASETS, load_dataset_config
from hil.world.scenario import SCENARIOS, load_scenario

ROOT = Path(__file__).parents[3]
LEAVES = st.none() | st.booleans() | st.integers(-9, 9) | st.text("ab: {}[]#", max_size=4)
TREES = st.recursive(
    LEAVES, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text("abc", max_size=3), inner)
)


@given(TREES)
def test_a_text_without_repeated_keys_is_read_as_by_the_lenient_readers(tree):
    assert parse_yaml(yaml.safe_dump(tree).encode(), "x") == tree
    assert parse_json(json.dumps(tree).encode(), "x") == tree


@given(
    st.floats(allow_nan=False, allow_infinity=False, width=32),
    st.sampled_from(["{:e}", "{:.3g}", "{:.0e}", "{!r}", "{:E}", "{:+.2e}", "{:#.0e}"]),
    st.booleans(),
)
def test_a_number_is_read_as_python_reads_it_however_its_exponent_is_written(number, form, short):
    text = form.format(number)
    text = text.replace("e+", "e").replace("E+", "E") if short else text
    value = parse_yaml(f"a: {text}".encode(), "x")["a"]
    assert isinstance(value, (int, float)) and value == float(text)
    assert parse_yaml(f"a: '{text}'\nb: x{text}\nc: {text}m".encode(), "x") == {
        "a": text,
        "b": f"x{text}",
        "c": f"{text}m",
    }


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\nb: 2\na: 3\n", r"^x\.a: is written twice, in lines 1 and 3$"),
        ("b:\n  c:\n  - 0\n  - {d: 1, e: 2,\n     d: 3}\n", r"^x\.b\.c\[1\]\.d: .* lines 4 and 5"),
        ("a: &loop [*loop]\nb: 1\nb: 2\n", r"^x\.b: is written twice"),
        ("a: [", r"^x: is not valid YAML"),
        ("day: 2026-13-01", r"^x: is not valid YAML"),
        ("\x00", r"^x: is not valid YAML"),
        ("[" * 5000, r"^x: is not valid YAML"),
    ],
)
def test_what_is_wrong_in_yaml_is_named(text, message):
    with pytest.raises(ConfigError, match=message):
        parse_yaml(text.encode(), "x")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"a": 1, "b": 2, "a": 3}', r"^x\.a: is written twice$"),
        ('{"b": {"c": [0, {"d": 1, "d": 3}]}}', r"^x\.b\.c\[1\]\.d: is written twice$"),
        ('{"a": {"d": 1, "d": 3}, "a": 1}', r"^x\.a: is written twice$"),
        ("{", r"^x: is not JSON"),
        ("\xff", r"^x: is not JSON"),
    ],
)
def test_what_is_wrong_in_json_is_named(text, message):
    with pytest.raises(ConfigError, match=message):
        parse_json(text.encode("latin-1"), "x")


READERS = {
    "mission": (ROOT / "mission.yaml", load_mission, "camera.width"),
    "scenario": (SCENARIOS / "fly-around.yaml", load_scenario, "fly_around.radial_m"),
    "dataset": (DATASETS / "obr-st.yaml", load_dataset_config, "frames"),
}


@pytest.mark.parametrize("kind", READERS)
@pytest.mark.parametrize("damage", ["repeated", "unknown", "wrong", "not YAML"])
def test_file_and_key_of_what_is_wrong_are_named(tmp_path, kind, damage):
    shipped, read, key = READERS[kind]
    path, name = tmp_path / "mine.yaml", key.rpartition(".")[2]
    line = next(line for line in shipped.read_text().splitlines() if line.strip().startswith(f"{name}:"))
    indent = line[: len(line) - len(line.lstrip())]
    changed = {
        "repeated": (f"{line}\n{line}", rf"{kind}\.{key}: is written twice"),
        "unknown": (f"{line}\n{indent}{name}s: 1", rf"{kind}\.{key}s: unknown key; expected one of .*{name}"),
        "wrong": (f"{indent}{name}: -1", rf"{kind}\.{key}: .*-1"),
        "not YAML": ("]", rf"{kind}: is not valid YAML"),
    }
    text, message = changed[damage]
    path.write_text(shipped.read_text().replace(line, text))
    with pytest.raises(ConfigError, match=f"^{path}: {message}"):
        read(path)
    path.write_text(shipped.read_text())
    read(path)


def test_a_wrong_orbit_of_a_scenario_is_named_by_the_scenarios_own_key(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text((SCENARIOS / "fly-around.yaml").read_text().replace("31698  97.4457", "31698  97.4458"))
    with pytest.raises(ConfigError, match=rf"^{path}: scenario\.target_tle\[1\]: checksum"):
        load_scenario(path)


def test_a_wrong_item_of_the_dictionary_is_named_by_its_whole_path():
    text = (ROOT / "flightsw" / "icd" / "dictionary.yaml").read_text()
    old = "rss_bytes: {type: uint64"
    assert old in text
    for new, message in (
        ("rss_bytes: {type: uint65", r"telemetry\.housekeeping\.rss_bytes\.type: expected a type"),
        ("rss_bytes: {typ: uint64", r"telemetry\.housekeeping\.rss_bytes\.typ: unknown key"),
        ("rss_bytes: {type: uint8, type: uint64", r"housekeeping\.items\.rss_bytes\.type: is written twice"),
    ):
        with pytest.raises(ConfigError, match=message):
            parse_dictionary(text.replace(old, new).encode())


def test_a_key_written_twice_in_a_session_or_a_transforms_file_is_named(tmp_path):
    (tmp_path / "session.json").write_text('{"schema_version": 1, "camera": {"fx_px": 1, "fx_px": 2}}')
    with pytest.raises(SessionCorrupt, match=rf"^{tmp_path}/session\.json: session\.camera\.fx_px: is wri"):
        open_session(tmp_path)
    path = tmp_path / "transforms_train.json"
    path.write_text('{"frames": [{"file_path": "a", "file_path": "b"}]}')
    with pytest.raises(FormatError, match=rf"^{path}: transforms\.frames\[0\]\.file_path: is written twice"):
        load_transforms(path)


def test_a_wrong_camera_of_a_session_is_named_by_the_sessions_own_key(tmp_path):
    golden = json.loads((ROOT / "tests" / "golden" / "session" / "session.json").read_text())
    golden["camera"]["width"] = 0
    (tmp_path / "session.json").write_text(json.dumps(golden))
    with pytest.raises(SessionCorrupt, match=r"session\.json: session\.camera\.width: expected 1 to 8192"):
        open_session(tmp_path)


def test_aliases_that_stand_for_billions_of_values_are_refused_without_writing_them_out():
    lists = "\n".join(f"a{k}: &a{k} [" + ", ".join([f"*a{k - 1}"] * 10) + "]" for k in range(1, 10))
    with pytest.raises(ConfigError, match="values with its aliases, at most 20000"):
        parse_yaml(f"a0: &a0 [x]\n{lists}\n".encode(), "mission")


def test_large_files_are_refused_by_their_size(tmp_path):
    with pytest.raises(ConfigError, match="mission: has 300000 bytes, at most 262144 are read"):
        parse_yaml(b"#" * 300_000, "mission")
    path = tmp_path / "mission.yaml"
    path.write_bytes(b"#" * 300_000)
    with pytest.raises(ConfigError, match="at most 262144 are read"):
        load_mission(path)
