"""On-board triage on the golden session: what the model has not seen ranks first."""

import json
import tempfile
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flightsw.cli import app
from flightsw.downlink.loop import run_downlink
from flightsw.errors import TriageError
from flightsw.icd.frame import HEADER, Frame, PoseTag, encode_frame
from flightsw.icd.link.can import FLIGHT_SIDE
from flightsw.icd.mission import load_mission
from flightsw.icd.model_file import MAX_MODEL_BYTES
from flightsw.icd.quaternion import quat_to_matrix
from flightsw.navigation.pose import unknown_pose
from flightsw.ports import open_link
from flightsw.storage.settings import Settings, save_settings
from flightsw.storage.store import FrameStore
from flightsw.triage.scores import (
    TILE_COLUMNS,
    TILE_ROWS,
    Ranked,
    Renderer,
    chi2_map,
    rank_frame,
    rank_frames,
    sending_order,
    sent_view,
    tile_means,
    verified_model,
)
from ground.link.ingest import listen
from hil.links.virtual_serial import VirtualSerial
from obbgs_core.io.onnx import export_onnx
from obbgs_core.sensor import Sensor
from tests.ground.test_moving_sun import lit_model
from tests.scenes import ball

GOLDEN = Path(__file__).parents[1] / "golden"
MISSION = load_mission(GOLDEN / "mission.yaml")
CAMERA = MISSION.camera
K = np.array(CAMERA.K)
SENSOR = Sensor(64, 4095, 4e7, 4, 8)


@pytest.fixture
def model(tmp_path) -> Path:
    """A small bright ball."""
    path = tmp_path / "model.onnx"
    export_onnx(ball(200, 0.8, -1.5, 1.5), SENSOR, path, CAMERA.width, CAMERA.height, CAMERA_EXPOSURES)
    return path


CAMERA_EXPOSURES = (5e-5, 2e-4)


FRONT, LEFT, TOP = np.array([[1.0, 0, 0, 0], [1, 0, 1, 0], [1, 1, 0, 0]]) / np.sqrt([[1], [2], [2]])


def frame_of(
    renderer: Renderer, frame_id: int, patch_dn: float, seed: int, quat: np.ndarray = FRONT
) -> Frame:
    """A frame of the ball from 300 m, with noise and a patch that the model does not know."""
    position = quat_to_matrix(quat).T @ np.array([0.0, 0, -300])
    pose = PoseTag(quat, position, np.eye(6), np.array([0, 0, 1.0]), False, True)
    dn = renderer.expected_dn(pose.world_to_camera, K, 1e-4, pose.sun_dir_body)[..., 0]
    variance = np.maximum(dn - 64, 0) / 4 + 64
    dn = dn + np.random.default_rng(seed).normal(size=dn.shape) * np.sqrt(variance)
    dn[25:35, 45:60] += patch_dn
    pixels = np.clip(dn.round(), 0, 4095).astype(np.uint16)
    return Frame(frame_id, 0, 0, 1, 1e-4, 10**18, pose, pixels, 12, 64.0, 0)


def test_the_worst_predicted_frame_comes_first_and_noise_scores_one(model, tmp_path):
    renderer, folder = Renderer(model), tmp_path / "frames"
    folder.mkdir()
    for frame_id, patch_dn in enumerate((0.0, 100.0, 20.0)):
        frame = frame_of(renderer, frame_id, patch_dn, seed=frame_id)
        (folder / f"{frame_id:08d}.obf").write_bytes(encode_frame(frame))
    (folder / "00000009.obf").write_bytes(b"not a frame")
    ranked, unreadable = rank_frames(model, tmp_path, K)
    assert [r.frame_id for r in ranked] == [1, 2, 0] and unreadable == 1
    # 800 pixels of pure noise: chi² of a tile is 1 with a standard deviation of 0.05, the worst of 8 tiles below 1.25
    assert ranked[-1].worst_chi2 < 1.25 and ranked[-1].mean_chi2 == pytest.approx(1, abs=0.1)
    assert (ranked[0].tile_row_px, ranked[0].tile_column_px) == (TILE_ROWS, TILE_COLUMNS)


def test_command_prints_the_ranking(model, tmp_path):
    from typer.testing import CliRunner

    (tmp_path / "frames").mkdir()
    frame = frame_of(Renderer(model), 3, 0.0, seed=0)
    (tmp_path / "frames" / "00000003.obf").write_bytes(encode_frame(frame))
    arguments = ["triage", "--model", str(model), "--store", str(tmp_path), "--json"]
    result = CliRunner().invoke(app, [*arguments, "--mission", str(GOLDEN / "mission.yaml")])
    assert result.exit_code == 0 and json.loads(result.stdout)["ranked"][0]["frame_id"] == 3
    (tmp_path / "frames" / "00000004.obf").write_bytes(b"damaged")
    result = CliRunner().invoke(app, [*arguments[:-1], "--mission", str(GOLDEN / "mission.yaml")])
    title, row = result.stdout.splitlines()[:2]
    assert title.startswith("rank  frame") and row.split()[:2] == ["1", "3"]
    assert "1 container could not be read" in result.stderr


def test_a_saturated_pixel_counts_only_when_the_model_is_darker():
    sensor = {"black_dn": 0.0, "white_dn": 100.0, "electrons_per_dn": 1.0, "read_noise_dn": 1.0}
    dn = np.full((1, 2, 1), 100.0)
    chi2 = chi2_map(dn, np.array([[[150.0], [50.0]]]), sensor)
    assert chi2[0, 0] == 0 and chi2[0, 1] > 40


def test_tile_means_cover_ragged_edges():
    image = np.random.default_rng(0).random((45, 90))
    tiles = tile_means(image)
    assert tiles.shape == (3, 3)
    assert tiles[2, 2] == pytest.approx(image[40:, 80:].mean()) and tiles[0, 1] == pytest.approx(
        image[:20, 40:80].mean()
    )


def damaged(model: Path, change) -> Path:
    """Return a copy of the model, changed."""
    proto = onnx.load(model)
    change(proto)
    path = model.with_name("damaged.onnx")
    onnx.save(proto, path)
    return path


def runtime_operator(proto):
    proto.graph.node[0].domain = "com.microsoft"


def hidden_in_a_subgraph(proto):
    inner = onnx.helper.make_graph(
        [onnx.helper.make_node("MatMul", ["a", "b"], ["c"], domain="com.microsoft")], "g", [], []
    )
    proto.graph.node[0].attribute.append(onnx.helper.make_attribute("body_of_evil", inner))


def data_elsewhere(proto):
    tensor = proto.graph.initializer[0]
    tensor.ClearField("raw_data")
    tensor.data_location = onnx.TensorProto.EXTERNAL
    entry = tensor.external_data.add()
    entry.key, entry.value = "location", "/etc/passwd"


def no_metadata(proto):
    del proto.metadata_props[:]


def impossible_sensor(proto):
    next(p for p in proto.metadata_props if p.key == "white_dn").value = "nan"


def other_operator(proto):
    proto.graph.node[0].op_type = "Evil"


def operators_that_do_not_fit(proto):
    proto.graph.node[0].op_type = "Softplus"


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (runtime_operator, "not standard ONNX: b'com.microsoft'"),
        (hidden_in_a_subgraph, "not standard ONNX: b'com.microsoft'"),
        (data_elsewhere, "keeps tensors outside the file"),
        (no_metadata, "metadata"),
        (impossible_sensor, "no sensor"),
        (other_operator, "no renderer of ours has: b'Evil'"),
        (operators_that_do_not_fit, "onnxruntime"),
    ],
)
def test_hostile_models_are_refused(model, change, problem):
    with pytest.raises(TriageError, match=problem):
        Renderer(damaged(model, change))


@pytest.mark.parametrize("content", [b"", b"\x08\x07junk", b"\xff" * 50, b"\x3a\xff\xff\xff\xff\x0f"])
def test_what_is_no_model_is_refused(tmp_path, content):
    (tmp_path / "junk.onnx").write_bytes(content)
    with pytest.raises(TriageError):
        Renderer(tmp_path / "junk.onnx")
    with pytest.raises(TriageError, match="No such file"):
        Renderer(tmp_path / "nowhere.onnx")


def test_a_model_that_is_too_large_is_not_even_read(tmp_path):
    with open(tmp_path / "large.onnx", "wb") as file:
        file.truncate(MAX_MODEL_BYTES + 1)
    with pytest.raises(TriageError, match=f"the limit is {MAX_MODEL_BYTES}"):
        verified_model(tmp_path / "large.onnx")


@given(st.binary(max_size=300))
def test_any_bytes_are_looked_through_or_refused(content):
    with tempfile.NamedTemporaryFile() as file:
        file.write(content)
        file.flush()
        try:
            assert verified_model(Path(file.name)) == content
        except TriageError as error:
            assert file.name in str(error)


def test_frames_in_eclipse_or_without_a_pose_come_last_whatever_their_residual(model, tmp_path):
    renderer = Renderer(model)
    for frame_id, changes in enumerate(({"in_eclipse": True}, {"valid": False}, {})):
        frame = frame_of(renderer, frame_id, 0.0 if frame_id == 2 else 200.0, seed=frame_id)
        frame = replace(frame, pose=replace(frame.pose, **changes))
        (tmp_path / f"{frame_id:08d}.obf").write_bytes(encode_frame(frame))
    ranked, _ = rank_frames(model, tmp_path, K)
    assert [r.frame_id for r in ranked if r.comparable] == [2] == [ranked[0].frame_id]
    assert {r.frame_id for r in ranked[1:]} == {0, 1}


@pytest.mark.parametrize("sh_count", [1, 4])
def test_a_frame_without_a_pose_or_a_sun_does_not_keep_a_model_from_ranking_the_others(tmp_path, sh_count):
    path, folder = tmp_path / "lit.onnx", tmp_path / "frames"
    folder.mkdir()
    export_onnx(lit_model(60, sh_count, 1), SENSOR, path, CAMERA.width, CAMERA.height, CAMERA_EXPOSURES)
    renderer = Renderer(path)
    for frame_id in range(3):
        frame = frame_of(renderer, frame_id, 20.0, seed=frame_id)
        if frame_id == 1:
            frame = replace(frame, pose=unknown_pose())
        (folder / f"{frame_id:08d}.obf").write_bytes(encode_frame(frame))
    ranked, unreadable = rank_frames(path, tmp_path, K)
    assert [r.frame_id for r in ranked][-1] == 1 and len(ranked) == 3 and unreadable == 0
    assert not ranked[-1].comparable


def test_a_folder_without_frames_and_frames_of_another_size_are_named(model, tmp_path):
    (tmp_path / "frames").mkdir()
    with pytest.raises(TriageError, match="no stored frames"):
        rank_frames(model, tmp_path, K)
    frame = frame_of(Renderer(model), 0, 0.0, seed=0)
    small = Frame(**{**vars(frame), "dn": np.ascontiguousarray(frame.dn[:40])})
    (tmp_path / "frames" / "00000000.obf").write_bytes(encode_frame(small))
    with pytest.raises(TriageError, match="72x40"):
        rank_frames(model, tmp_path, K)


def ranked(frame_id: int, worst_chi2: float, view: tuple[float, ...], comparable: bool = True) -> Ranked:
    return Ranked(frame_id, Path(f"{frame_id:08d}.obf"), worst_chi2, 1.0, 0, 0, comparable, view)


SUN = (0.0, 0.0, 1.0)


def test_a_new_view_goes_before_repeats_of_a_worse_predicted_one():
    front, near_front, side, back = (1.0, 0.0, 0.0), (0.995, 0.0998, 0.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0)
    frames = [
        ranked(0, 100.0, front + SUN),
        ranked(1, 90.0, near_front + SUN),
        ranked(2, 20.0, side + SUN),
        ranked(3, 1.1, back + SUN),  # new, but all noise
        ranked(4, 95.0, (*front, *side)),  # the same view in another light is another view
    ]
    assert [r.frame_id for r in sending_order(frames, [])] == [0, 4, 2, 1, 3]
    assert [r.frame_id for r in sending_order(frames, [front + SUN])] == [4, 2, 0, 1, 3]


directions = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)
views = st.builds(
    lambda v, s: (*(np.array([v, s]) / np.linalg.norm([v, s], axis=1)[:, None]).ravel(),), *[directions] * 2
)


@given(
    st.lists(st.tuples(st.floats(0, 1e6), views, st.booleans()), max_size=30),
    st.lists(views, max_size=5),
    st.integers(0, 40),
)
def test_every_frame_has_one_place_and_the_bound_on_time_changes_no_earlier_one(facts, sent, first):
    frames = [ranked(i, *fact) for i, fact in enumerate(facts)]
    order = [r.frame_id for r in sending_order(frames, sent)]
    assert sorted(order) == list(range(len(frames)))
    comparable = [frames[i].comparable for i in order]
    assert comparable == sorted(comparable, reverse=True)
    bounded = [r.frame_id for r in sending_order(frames, sent, first)]
    assert bounded[:first] == order[:first] and sorted(bounded) == sorted(order)
    if any(comparable) and not sent:
        assert frames[order[0]].residual_sigmas == max(r.residual_sigmas for r in frames if r.comparable)


def test_the_view_of_a_sent_frame_is_that_of_its_ranking_and_none_in_eclipse(model, tmp_path):
    frame = frame_of(Renderer(model), 0, 0.0, 0, LEFT)
    container = encode_frame(frame)
    (tmp_path / "00000000.obf").write_bytes(container)
    (score,), _ = rank_frames(model, tmp_path, K)
    # looking along the body's x axis, turned by 90 degrees about y: the camera stands on that axis
    assert (
        score.view == pytest.approx((1, 0, 0, 0, 0, 1)) and sent_view(container[: HEADER.size]) == score.view
    )
    dark = encode_frame(replace(frame, pose=replace(frame.pose, in_eclipse=True)))
    assert sent_view(dark[: HEADER.size]) is None


def test_over_the_link_an_informative_view_comes_before_repeats_of_what_the_ground_has(model, tmp_path):
    renderer, session = Renderer(model), tmp_path / "session"
    store = FrameStore(tmp_path / "store")
    # 0 has come down already; 1 and 2 repeat its view, worse predicted than 4 from the side; 3 from the top is noise
    for frame_id, (patch_dn, quat) in enumerate(
        [(150.0, FRONT), (140.0, FRONT), (160.0, FRONT), (0.0, TOP), (60.0, LEFT)]
    ):
        store.put(frame_of(renderer, frame_id, patch_dn, frame_id, quat))
    store.mark_delivered(0)
    (store.folder / "model.onnx").write_bytes(model.read_bytes())
    save_settings(store.folder, Settings(priority="triage"))
    with VirtualSerial(3_000_000) as line, open_link(line.flight_url, FLIGHT_SIDE) as link:
        ended = threading.Event()
        ground = threading.Thread(
            target=listen, args=(line.ground_url, session, MISSION), kwargs={"should_stop": ended.is_set}
        )
        ground.start()
        try:
            run_downlink(store, link, MISSION, exit_when_empty=True)
        finally:
            ended.set()
            ground.join(30)
    received = [json.loads(text)["id"] for text in (session / "frames.jsonl").read_text().splitlines()]
    assert received == [4, 2, 1, 3]


def test_a_frame_of_other_channels_than_the_model_renders_is_refused(model):
    renderer = Renderer(model)
    frame = frame_of(renderer, 3, 0.0, seed=0)
    colour = replace(frame, dn=np.repeat(frame.dn.reshape(*frame.dn.shape[:2], 1), 3, axis=2))
    with pytest.raises(TriageError, match="frame 3 has 3 channels, the model renders 1"):
        rank_frame(renderer, colour, Path("3.obf"), np.eye(3))
