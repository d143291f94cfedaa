"""Models that grow, do not end or die: they cost their own process, and neither the link nor its frames."""

import dataclasses
import hashlib
import json
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from flightsw.icd.frame import encode_frame
from flightsw.icd.model_file import OPERATORS, ModelUnfit, check_model
from flightsw.storage.settings import Settings, save_settings
from flightsw.storage.store import FrameStore
from flightsw.triage.model_process import Limits, tried
from flightsw.triage.ranking import RANKING_S, Ranking
from flightsw.triage.scores import Ranked, rank_frames
from flightsw.triage.worker import ModelFailed, ModelVerified, Result, TriageWorker
from ground.link.ingest import listen
from hil.links.virtual_serial import VirtualSerial
from obbgs_core.io.onnx import export_onnx
from obbgs_core.sensor import Sensor
from tests.conftest import SIZE_PX
from tests.ground.test_moving_sun import lit_model
from tests.obbgs_core.test_highlights import shining
from tests.scenes import ball

SENSOR = Sensor(64, 4095, 4e7, 4, 8)
SMALL = Limits(time_s=3.0)
ENDLESS = Limits(time_s=1000.0)
PATIENT_S = 120.0


@pytest.fixture
def model(tmp_path) -> Path:
    """A small bright ball."""
    path = tmp_path / "ball.onnx"
    export_onnx(ball(200, 0.8, -1.5, 1.5), SENSOR, path, SIZE_PX, SIZE_PX, [1e-4])
    return path


@pytest.fixture
def new_worker(small_mission):
    """Return a function that makes workers, all of which end with the test."""
    made = []

    def make(limits: Limits = SMALL, width: int = SIZE_PX) -> TriageWorker:
        made.append(TriageWorker(np.array(small_mission.camera.K), width, SIZE_PX, limits))
        return made[-1]

    yield make
    for each in made:
        each.stop()


@pytest.fixture
def container(tmp_path, make_frame):
    """Return a function that writes a frame and returns its path."""

    def write(frame_id: int, exposure_time_s: float = 1e-4) -> Path:
        path = tmp_path / f"{frame_id:08d}.obf"
        frame = dataclasses.replace(make_frame(frame_id), exposure_time_s=exposure_time_s)
        path.write_bytes(encode_frame(frame))
        return path

    return write


def results(worker: TriageWorker, count: int) -> list[Result]:
    done: list[Result] = []
    end_s = time.monotonic() + PATIENT_S
    while len(done) < count and time.monotonic() < end_s:
        done += worker.results()
        time.sleep(0.01)
    return done


def crafted(path: Path, *nodes: onnx.NodeProto, functions=(), **constants: np.ndarray) -> Path:
    """Write a model with inputs, output and metadata as ours; its nodes make a number `s` of exposure_time_s."""
    inputs = {"world_to_camera": [4, 4], "K": [3, 3], "exposure_time_s": []}
    size = [SIZE_PX, SIZE_PX, 1]
    values = {"zero": np.zeros(size, dtype=np.float32), "one": np.array([1], dtype=np.int64)} | constants
    graph = helper.make_graph(
        [*nodes, helper.make_node("Add", ["zero", "s"], ["image"])],
        "crafted",
        [helper.make_tensor_value_info(n, TensorProto.FLOAT, shape) for n, shape in inputs.items()],
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, size)],
        [numpy_helper.from_array(value, name) for name, value in values.items()],
    )
    opset = [helper.make_opsetid("", 18)]
    proto = helper.make_model(graph, opset_imports=opset, ir_version=9, functions=functions)
    facts = {**vars(SENSOR), "width": SIZE_PX, "height": SIZE_PX}
    helper.set_model_props(proto, {name: str(value) for name, value in facts.items()})
    path.write_bytes(proto.SerializeToString())
    return path


def product(length: int) -> tuple[list[onnx.NodeProto], np.ndarray]:
    """Return the nodes of a square matrix that does not stand in the file, and the vector `v` that does."""
    nodes = [
        helper.make_node("Mul", ["v", "exposure_time_s"], ["a"]),
        helper.make_node("Transpose", ["a"], ["b"]),
        helper.make_node("MatMul", ["a", "b"], ["product"]),
    ]
    return nodes, np.ones((length, 1), dtype=np.float32)


def that_grows(path: Path) -> Path:
    """A matrix of 64 GB, from a file of half a megabyte."""
    nodes, v = product(1 << 17)
    return crafted(path, *nodes, helper.make_node("ReduceSum", ["product"], ["s"], keepdims=0), v=v)


def that_turns(path: Path, turns_per_exposure_s: float) -> Path:
    """A Scan of so many turns for each second of exposure: 1e11 are for minutes at the first picture already."""
    value = helper.make_tensor_value_info
    body = helper.make_graph(
        [helper.make_node("Abs", ["x"], ["y"])],
        "body",
        [value("x", TensorProto.FLOAT, [])],
        [value("y", TensorProto.FLOAT, [])],
    )
    nodes, v = product(1 << 12)
    return crafted(
        path,
        *nodes,
        helper.make_node("Reshape", ["product", "all"], ["many"]),
        helper.make_node("Mul", ["exposure_time_s", "turns"], ["count"]),
        helper.make_node("Cast", ["count"], ["end"], to=TensorProto.INT64),
        helper.make_node("Reshape", ["end", "one"], ["ends"]),
        helper.make_node("Slice", ["many", "start", "ends"], ["some"]),
        helper.make_node("Scan", ["some"], ["turned"], body=body, num_scan_inputs=1),
        helper.make_node("ReduceSum", ["turned"], ["s"], keepdims=0),
        v=v,
        all=np.array([-1], dtype=np.int64),
        start=np.array([0], dtype=np.int64),
        turns=np.array(turns_per_exposure_s, dtype=np.float32),
    )


AT_ONCE, FOR_LONG_EXPOSURES = (
    1e11,
    1e8,
)  # exposures of 100 ms, a thousand times as long as that of the first picture
LONG_S = 0.1


def test_every_kind_of_renderer_that_the_ground_writes_is_made_of_the_operators_that_are_taken(
    tmp_path, small_mission
):
    """One with another operator would need new flight software; one operator more is taken for no reason."""
    used, K = set(), np.array(small_mission.camera.K)
    for number, (sh_count, footprint, has_lobes, background) in enumerate(
        [
            (1, "kerbl", False, 0.0),
            (4, "mip-splatting", False, 0.5),
            (1, "camera", True, 0.0),
            (4, "camera", True, 0.0),
        ]
    ):
        gaussians = dataclasses.replace(lit_model(60, sh_count, 1), footprint=footprint)
        if has_lobes:
            gaussians = shining(gaussians)
        path = tmp_path / f"{number}.onnx"
        export_onnx(gaussians, SENSOR, path, SIZE_PX, SIZE_PX, [1e-4], background=background)
        assert tried(path, SIZE_PX, SIZE_PX, K).turns_with_sun
        used |= operators(onnx.load(path).graph)
    path = tmp_path / "seen.onnx"
    export_onnx(ball(200, 0.8, -1.5, 1.5), SENSOR, path, SIZE_PX, SIZE_PX, [1e-4])
    assert not tried(path, SIZE_PX, SIZE_PX, K).turns_with_sun
    assert used | operators(onnx.load(path).graph) == {name.decode() for name in OPERATORS}


def operators(graph: onnx.GraphProto) -> set[str]:
    """Return the operators of a graph and of the bodies in it, as the onnx package reads them."""
    bodies = [attribute.g for node in graph.node for attribute in node.attribute if attribute.HasField("g")]
    return {node.op_type for node in graph.node}.union(*(operators(body) for body in bodies))


def test_a_model_that_needs_too_much_memory_or_time_is_told_and_the_one_in_use_goes_on(
    model, tmp_path, new_worker, container
):
    worker = new_worker()
    good = ModelVerified(model, hashlib.sha256(model.read_bytes()).digest(), None)
    worker.verify(model)
    assert results(worker, 1) == [good]
    worker.verify(that_grows(tmp_path / "grows.onnx"))
    worker.verify(that_turns(tmp_path / "turns.onnx", AT_ONCE))
    frame = container(3)
    worker.rank(container(2))
    worker.forget_frames()  # both models still wait
    worker.rank(frame)
    grown, turned, ranked = results(worker, 3)
    assert isinstance(grown, ModelVerified) and grown.is_unfit and "while it renders" in str(grown.problem)
    assert isinstance(turned, ModelVerified) and turned.is_unfit and "3 s" in str(turned.problem)
    assert isinstance(ranked, tuple) and isinstance(ranked[1], Ranked) and ranked[1].frame_id == 3


def test_a_new_model_does_not_wait_for_frames_and_a_bad_one_leaves_the_good_one(
    model, tmp_path, new_worker, container, small_mission
):
    frames = [container(0), container(1)]
    expected, _ = rank_frames(model, tmp_path, np.array(small_mission.camera.K))
    other_camera = tmp_path / "other.onnx"
    export_onnx(ball(50, 0.8, -1.5, 1.5), SENSOR, other_camera, SIZE_PX + 1, SIZE_PX, [1e-4])
    worker = new_worker()
    worker.rank(frames[0])
    assert results(worker, 1) == [(frames[0], None)]  # without a model
    worker.verify(model)
    worker.verify(other_camera)
    for path in (*frames, tmp_path / "00000009.obf"):  # the last is gone
        worker.rank(path)
    good, bad, *ranked, gone = results(worker, 5)
    assert good == ModelVerified(model, hashlib.sha256(model.read_bytes()).digest(), None)
    assert isinstance(bad, ModelVerified)
    assert bad.problem == f"the model renders {SIZE_PX + 1}x{SIZE_PX}, the camera has {SIZE_PX}x{SIZE_PX}"
    assert gone == (tmp_path / "00000009.obf", None)
    assert [path for path, _ in ranked] == frames  # type: ignore[misc]
    assert {score for _, score in ranked} == set(expected)  # type: ignore[misc]


def test_a_model_that_hangs_or_dies_at_a_frame_ranks_no_more(model, tmp_path, new_worker, container):
    worker = new_worker()
    worker.verify(that_turns(tmp_path / "turns.onnx", FOR_LONG_EXPOSURES))
    worker.rank(container(1))
    worker.rank(container(2, LONG_S))
    worker.rank(container(3))
    verified, ranked, failed, without = results(worker, 4)
    assert isinstance(verified, ModelVerified) and verified.problem is None
    assert isinstance(ranked, tuple) and ranked[1] is not None
    assert isinstance(failed, ModelFailed) and failed.problem.endswith("at 00000002.obf")
    assert without == (container(3), None)
    worker.verify(model)
    results(worker, 1)
    (process,) = worker.processes
    process.kill()  # as the system does where memory ends
    worker.rank(container(4))
    (died,) = results(worker, 1)
    assert isinstance(died, ModelFailed) and signal.SIGKILL.name in died.problem


def test_the_process_of_a_hanging_model_is_gone_once_the_worker_has_stopped(tmp_path, new_worker):
    worker = new_worker(ENDLESS)
    worker.verify(that_turns(tmp_path / "turns.onnx", AT_ONCE))
    while not worker.processes:
        time.sleep(0.01)
    (process,) = worker.processes
    worker.stop()
    assert process.exit_code == -signal.SIGKILL and not worker.processes and worker.results() == []


def asked(model: Path, small_mission, *containers: Path, without: str = "") -> subprocess.CompletedProcess:
    """Run a model's process with these lines and no more, as where flight is gone, on a computer without a module."""
    task = {
        "model": str(model),
        "width": SIZE_PX,
        "height": SIZE_PX,
        "K": small_mission.camera.K,
        "limits": {"time_s": 1.0, "memory_bytes": 1 << 30},
    }
    lines = "".join(json.dumps(each) + "\n" for each in (task, *map(str, containers)))
    hide = f"import sys; sys.modules[{without!r}] = None; " if without else ""
    child = [sys.executable, "-c", f"{hide}from flightsw.triage.model_process import main; main()"]
    return subprocess.run(child, input=lines, capture_output=True, text=True, timeout=PATIENT_S)


def test_a_hanging_model_whose_flight_software_was_killed_ends_by_its_processor_time(tmp_path, small_mission):
    """Nobody is left to kill it then."""
    done = asked(that_turns(tmp_path / "turns.onnx", AT_ONCE), small_mission)
    assert done.returncode == -signal.SIGXCPU and done.stdout == "{}\n"


def test_the_process_of_a_model_answers_each_line_and_ends_with_its_input(
    model, tmp_path, container, small_mission
):
    (expected,), _ = rank_frames(model, container(3).parent, np.array(small_mission.camera.K))
    done = asked(model, small_mission, container(3), tmp_path / "00000009.obf")
    begun, verified, ranked, gone = map(json.loads, done.stdout.splitlines())
    assert (done.returncode, done.stderr, begun) == (0, "", {})
    assert verified == {"sha256": hashlib.sha256(model.read_bytes()).hexdigest()}
    assert Ranked(**ranked | {"path": container(3), "view": tuple(ranked["view"])}) == expected
    assert "No such file" in gone["problem"]


def test_without_onnxruntime_no_model_is_to_blame(model, small_mission):
    done = asked(model, small_mission, without="onnxruntime")
    answer = json.loads(done.stdout.splitlines()[1])
    assert "triage needs onnxruntime" in answer["problem"] and not answer["is_unfit"]


def test_without_a_process_the_model_is_not_verified_and_not_to_blame(model, new_worker, monkeypatch):
    worker = new_worker()
    with monkeypatch.context() as change:
        change.setattr(sys, "executable", "/nowhere/python")
        worker.verify(model)
        (cannot_start,) = results(worker, 1)
    with monkeypatch.context() as change:
        change.setattr(sys, "executable", "/bin/false")
        worker.verify(model)
        (ends_at_once,) = results(worker, 1)
    worker.verify(model)
    (good,) = results(worker, 1)
    for failed in (cannot_start, ends_at_once):
        assert isinstance(failed, ModelVerified) and failed.problem and not failed.is_unfit
    assert isinstance(good, ModelVerified) and good.problem is None


class ScriptedWorker:
    """Gives the results that a test puts in, and notes what it is asked for."""

    def __init__(self, *_: object):
        self.verified: list[Path] = []
        self.ranked: list[Path] = []
        self.to_give: list[Result] = []
        self.verify, self.rank = self.verified.append, self.ranked.append

    def results(self) -> list[Result]:
        given, self.to_give = self.to_give, []
        return given

    def forget_frames(self) -> None:
        self.ranked.clear()


@pytest.fixture
def ranking(tmp_path, small_mission, make_frame, monkeypatch):
    """Return a ranking of a store of four frames with a model, its scripted worker and a clock to be set."""
    workers: list[ScriptedWorker] = []

    def worker(*_: object) -> ScriptedWorker:
        workers.append(ScriptedWorker())
        return workers[-1]

    monkeypatch.setattr("flightsw.triage.ranking.TriageWorker", worker)
    store, clock = FrameStore(tmp_path / "store"), [0.0]
    for number in range(4):
        store.put(make_frame(number))
    (store.folder / "model.onnx").write_bytes(b"of the run before")
    made = Ranking(store, small_mission.camera, lambda: clock[0])
    made.start()
    return made, workers[0], clock


def good(path: Path) -> ModelVerified:
    return ModelVerified(path, bytes(32), None)


def score(path: Path, chi2: float) -> tuple[Path, Ranked]:
    return path, Ranked(int(path.stem), path, chi2, chi2, 0, 0, True, (1.0, 0.0, 0.0, 0.0, 0.0, 1.0))


def test_frames_wait_30_s_for_a_model_and_no_longer(ranking):
    made, worker, clock = ranking
    frames, held = [0, 1, 2, 3], RANKING_S - 1
    assert worker.verified == [made.model_path]
    assert made.ordered(frames, held) == [] and made.ordered(frames, RANKING_S) == frames
    clock[0] = 100.0
    worker.to_give = [good(made.model_path)]
    made.collect()
    made.rank(frames[:3])
    clock[0] = 110.0
    worker.to_give = [score(worker.ranked[1], 2.0)]
    made.collect()
    assert made.ordered(frames, 100 + held) == []
    made.rank(frames)  # the last one is new
    assert made.ordered(frames, 100 + RANKING_S) == [1, 0, 2]
    assert made.ordered(frames, 110 + RANKING_S) == [1, 0, 2, 3]


def test_a_model_that_fails_is_told_set_aside_and_not_tried_again(ranking, small_mission, caplog):
    made, worker, _ = ranking
    folder = made.model_path.parent
    worker.to_give = [good(made.model_path)]
    made.collect()
    made.rank([0, 1])
    worker.to_give = [score(worker.ranked[0], 2.0), ModelFailed("the model took too long, at 00000001.obf")]
    made.collect()
    assert "the model took too long, at 00000001.obf" in caplog.text
    assert made.model_sha256 == b"" and made.frames_ranked == 0 and made.ordered([0, 1], 31.0) == [0, 1]
    assert [path.name for path in folder.glob("model*")] == ["model.onnx.failed"]
    again = Ranking(FrameStore(folder), small_mission.camera, lambda: 0.0)
    again.start()
    assert again.ordered([0, 1], 0.0) == [0, 1]


@pytest.mark.parametrize(("is_unfit", "kept"), [(True, "model.onnx.failed"), (False, "model.onnx")])
def test_a_model_on_board_is_kept_where_the_computer_is_to_blame(ranking, is_unfit, kept):
    made, worker, _ = ranking
    worker.to_give = [ModelVerified(made.model_path, b"", "onnxruntime is missing", is_unfit)]
    (verified,) = made.collect()
    assert verified.problem == "onnxruntime is missing" and made.ordered([0, 1], 0.0) == [0, 1]
    assert [path.name for path in made.model_path.parent.glob("model*")] == [kept]


def test_a_disk_that_refuses_keeps_no_model_from_ranking(ranking, monkeypatch, caplog):
    made, worker, _ = ranking

    def refuse(*_: object, **__: object) -> None:
        raise OSError(30, "Read-only file system")

    received = made.model_path.with_name("model-7.received")
    received.write_bytes(b"new")
    with monkeypatch.context() as change:
        for call in ("os.replace", "pathlib.Path.unlink"):
            change.setattr(call, refuse)
        worker.to_give = [ModelVerified(received.with_name("model-6.received"), b"", "bad"), good(received)]
        assert [verified.problem for verified in made.collect()] == ["bad", None]
        made.start()
        worker.to_give = [ModelFailed("the model took too long")]
        made.collect()
    assert "it cannot be kept: " in caplog.text and "tried again at the next start" in caplog.text


FLIGHT = """
import functools, sys
import flightsw.triage.ranking as ranking
from flightsw.cli import main
from flightsw.triage.model_process import Limits
limits = Limits(time_s=float(sys.argv.pop(1)))
ranking.RANKING_S, ranking.TriageWorker = 1.0, functools.partial(ranking.TriageWorker, limits=limits)
main()
"""


def models_of(flight: subprocess.Popen) -> list[int]:
    """Return the processes of models that belong to a flight process."""
    children = Path(f"/proc/{flight.pid}/task").glob("*/children")
    return [int(number) for each in children for number in each.read_text().split()]


def wait_for(is_so, patience_s: float = PATIENT_S) -> None:
    end_s = time.monotonic() + patience_s
    while not is_so() and time.monotonic() < end_s:
        time.sleep(0.02)
    assert is_so()


def test_a_hanging_model_stops_neither_the_link_nor_the_end_of_the_flight_process(
    tmp_path, small_mission, make_frame
):
    """Over a pseudo-terminal: with a limit that it never reaches frames come down all the same, and SIGTERM ends both.

    With a limit of 1 s it is told and set aside, and its process is gone while flight goes on.
    """
    store, session, ended = FrameStore(tmp_path / "store"), tmp_path / "session", threading.Event()
    for number in range(4):
        store.put(make_frame(number))
    model, failed = that_turns(store.folder / "model.onnx", AT_ONCE), store.folder / "model.onnx.failed"
    save_settings(store.folder, Settings(priority="triage"))

    def told() -> str:
        events = session / "events.jsonl"
        return events.read_text() if events.exists() else ""

    with VirtualSerial(3_000_000) as line:
        arguments = (line.ground_url, session, small_mission)
        ground = threading.Thread(target=listen, args=arguments, kwargs={"should_stop": ended.is_set})
        ground.start()
        command = ["downlink", "--link", line.flight_url, "--store", str(store.folder)]
        command += ["--mission", str(tmp_path / "small.yaml")]
        try:
            for limit_s in (1000.0, 1.0):
                flight = subprocess.Popen([sys.executable, "-c", FLIGHT, str(limit_s), *command])
                try:
                    if limit_s > 1:
                        wait_for(lambda: not store.outbox())
                        (hanging,) = models_of(flight)
                        assert model.exists()
                    else:
                        wait_for(lambda: "did not come to an end within 1 s" in told())
                        assert failed.exists() and not model.exists() and not models_of(flight)
                    flight.terminate()
                    assert flight.wait(PATIENT_S) == 0
                finally:
                    flight.kill()
                    flight.wait()
                assert not Path(f"/proc/{hanging}").exists()
        finally:
            ended.set()
            ground.join(30)
    assert len((session / "frames.jsonl").read_text().splitlines()) == 4


def node(kind: str, **attributes: object) -> onnx.NodeProto:
    return helper.make_node(kind, ["exposure_time_s"], ["s"], **attributes)


def scan_in_a_scan() -> onnx.NodeProto:
    empty = helper.make_graph([], "empty", [], [])
    inner = helper.make_graph([node("Scan", body=empty, num_scan_inputs=1)], "inner", [], [])
    return node("Scan", body=inner, num_scan_inputs=1)


def test_operators_that_loop_or_grow_are_refused_wherever_they_stand(tmp_path):
    path = tmp_path / "evil.onnx"
    empty = helper.make_graph([], "empty", [], [])
    opset = [helper.make_opsetid("", 18)]
    function = helper.make_function("", "Abs", ["x"], ["y"], [helper.make_node("Abs", ["x"], ["y"])], opset)
    cases = [
        (node(kind), f"no renderer of ours has: b'{kind}'")
        for kind in ("Tile", "Expand", "Resize", "ConstantOfShape", "Range", "OneHot", "EyeLike")
    ]
    cases += [
        (node("Loop", body=empty), "no renderer of ours has: b'Loop'"),
        (node("If", then_branch=empty, else_branch=empty), "no renderer of ours has: b'If'"),
        (scan_in_a_scan(), "inside a Scan: b'Scan'|a loop in a loop"),
        (node("Abs", body=helper.make_graph([node("Tile")], "g", [], [])), "inside a Scan: b'Tile'"),
    ]
    for evil, message in cases:
        with pytest.raises(ModelUnfit, match=message):
            check_model(crafted(path, evil).read_bytes())
    with pytest.raises(ModelUnfit, match="functions of its own"):
        check_model(crafted(path, node("Abs"), functions=[function]).read_bytes())
    check_model(crafted(path, node("Abs")).read_bytes())
