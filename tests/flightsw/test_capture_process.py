"""`flightsw capture` as a process: stopped, killed at random moments, its store full, and automatic brackets."""

import contextlib
import dataclasses
import json
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from flightsw.icd.frame import decode_frame
from flightsw.icd.mission import load_mission
from flightsw.storage.fsck import fsck
from flightsw.storage.settings import Settings, save_settings
from flightsw.storage.store import FrameStore
from hil.cameras.virtual import CameraServer

COUNT = 40


@contextlib.contextmanager
def camera(mission, radiance: float = 0.4, delay_s: float = 0.0) -> Iterator[CameraServer]:
    """The simulated camera in front of an even plate that fills a quarter of the picture."""

    def sky(pose) -> np.ndarray:
        time.sleep(delay_s)
        picture = np.zeros((mission.camera.height, mission.camera.width, 1))
        picture[12:36, 12:36] = radiance
        return picture

    with CameraServer(mission, sky, "hil://127.0.0.1:0") as server:
        yield server


def start(tmp_path: Path, server: CameraServer, *arguments: str) -> subprocess.Popen:
    return subprocess.Popen(
        [
            str(Path(sys.executable).with_name("flightsw")),
            *("capture", "--camera", server.url, "--mission", str(tmp_path / "small.yaml")),
            *("--store", str(tmp_path / "store"), "--json", *arguments),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def finish(process: subprocess.Popen) -> tuple[dict, str]:
    out, err = process.communicate(timeout=120)
    return (json.loads(out) if out.strip() else {}), err


def wait_for_frames(store: Path, count: int, process: subprocess.Popen) -> None:
    deadline_s = time.monotonic() + 60
    while len(list(store.glob("frames/*.obf"))) < count:
        assert process.poll() is None and time.monotonic() < deadline_s
        time.sleep(0.005)


def test_a_store_takes_the_frames_of_one_process_until_that_ends(tmp_path, small_mission):
    store = FrameStore(tmp_path / "store")
    with camera(small_mission) as server:
        with store.capturing():
            refused = start(tmp_path, server, "--count", "2")
            _, error = finish(refused)
            assert refused.returncode == 1 and len(error.splitlines()) == 1
            assert "another process takes frames into" in error and "--store" in error
            assert len(FrameStore(tmp_path / "store").frames) == 0
        told, _ = finish(start(tmp_path, server, "--count", "2"))
    assert told["frames_stored"] > 0


def test_the_pass_of_a_simulated_camera_stands_still_in_safe_mode(tmp_path, small_mission):
    store = FrameStore(tmp_path / "store")
    save_settings(store.folder, Settings("oldest", safe_mode=True))
    with camera(small_mission) as server:
        process = start(tmp_path, server, "--count", "2")
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(timeout=4)
        save_settings(store.folder, Settings("oldest"))
        told, _ = finish(process)
    assert told["frames_stored"] == 2 * len(small_mission.bracket.exposure_times_ms)


def test_a_kill_at_any_moment_loses_at_most_the_frame_being_exposed(tmp_path, small_mission):
    rng = random.Random(4)
    kills = 4
    with camera(small_mission, delay_s=0.004) as server:
        for _ in range(kills):
            before = len(list((tmp_path / "store").glob("frames/*.obf")))
            process = start(tmp_path, server, "--count", str(COUNT))
            wait_for_frames(tmp_path / "store", before + 1, process)
            time.sleep(rng.uniform(0, 0.15))
            process.kill()
            finish(process)
            time.sleep(0.05)  # the camera notices
        stored = len(FrameStore(tmp_path / "store").frames)
        assert 0 <= server.exposures - stored <= kills  # one frame a kill at most
        result, err = finish(start(tmp_path, server, "--count", str(COUNT)))
        assert server.exposures <= 3 * COUNT + kills
    assert result["capture"]["stored"] + result["capture"]["already_stored"] == 3 * COUNT, err
    assert fsck(tmp_path / "store", repair=False).problems == []
    store = FrameStore(tmp_path / "store")
    frames = [decode_frame(store.read(stored.frame_id)) for stored in store.frames]
    assert len({(f.bracket_id, f.bracket_index) for f in frames}) == len(frames) == 3 * COUNT
    assert store.outbox() == [f.frame_id for f in frames] == sorted({f.frame_id for f in frames})


def test_sigterm_ends_cleanly_with_the_counts(tmp_path, small_mission):
    with camera(small_mission, delay_s=0.01) as server:
        process = start(tmp_path, server, "--count", "1000")
        wait_for_frames(tmp_path / "store", 3, process)
        process.send_signal(signal.SIGTERM)
        result, err = finish(process)
    assert process.returncode == 0, err
    assert 3 <= result["capture"]["stored"] == result["frames_stored"] < 3000
    assert server.exposures == result["capture"]["stored"]
    assert fsck(tmp_path / "store", repair=False).problems == []


@pytest.mark.parametrize(("policy", "refused"), [("refuse", True), ("drop-oldest", False)])
def test_a_full_store_never_ends_the_pass(tmp_path, small_mission, policy, refused):
    path = tmp_path / "small.yaml"
    path.write_text(path.read_text() + f"store: {{quota_mb: 0.02, when_full: {policy}}}\n")
    with camera(small_mission) as server:
        process = start(tmp_path, server, "--count", "10")
        result, err = finish(process)
    counts = result["capture"]
    assert counts["planned"] == 30 == counts["stored"] + counts["refused"]
    assert bool(counts["refused"]) == refused
    assert process.returncode == 1  # frames are lost by either policy
    store = FrameStore(tmp_path / "store")
    assert counts["dropped"] == counts["stored"] - len(store.frames) and bool(counts["dropped"]) != refused
    assert 0 < store.used_bytes <= 20_000
    newest = max(stored.bracket_id for stored in store.frames)
    assert (newest == 9) != refused
    assert ("refused: the quota" in err) == refused
    assert ("deleted undelivered" in err) != refused


def test_automatic_brackets_find_a_target_darker_than_expected(tmp_path, small_mission):
    with camera(small_mission, radiance=0.01) as server:
        result, err = finish(start(tmp_path, server, "--bracket", "auto", "--count", "6"))
    assert result["capture"]["stored"] == 18, err  # six triggers 27 s apart
    store = FrameStore(tmp_path / "store")
    frames = [decode_frame(store.read(stored.frame_id)) for stored in store.frames]
    first, last = frames[:3], frames[-3:]
    assert max(f.dn.max() for f in first) < 1000  # the first guess was for a bright target
    assert 2000 < min(last, key=lambda f: f.exposure_time_s).dn.max() < 4095
    assert sorted(f.exposure_time_s for f in last) == [f.exposure_time_s for f in last]


def test_poses_from_a_navigation_file_go_into_the_frames_and_gaps_are_counted(tmp_path, small_mission):
    from flightsw.navigation.pose import pose_tag

    start_ns = small_mission.orbit.start_utc_ns
    lines = []
    for second in range(60):
        if 20 <= second < 40:
            continue  # the filter lost its way during the second bracket
        tag = pose_tag(small_mission, start_ns + second * 10**9)
        entry = {"utc_ns": start_ns + second * 10**9, "covariance": (np.eye(6) * 1e-4).tolist()}
        entry["quat_body_to_camera"] = tag.quat_body_to_camera.tolist()
        entry["position_body_m"] = tag.position_body_m.tolist()
        lines.append(json.dumps(entry))
    (tmp_path / "states.jsonl").write_text("\n".join(lines) + "\n")
    path = tmp_path / "small.yaml"
    tight = path.read_text().replace("# frame_spacing_s: 0.5", "frame_spacing_s: 0.5")
    path.write_text(f"{tight}navigation: {{source: 'file://{tmp_path}/states.jsonl', wait_s: 0.0}}\n")
    mission = load_mission(path)
    with camera(mission) as server:
        result, err = finish(start(tmp_path, server, "--count", "3"))
    counts = result["capture"]
    assert (counts["stored"], counts["pose_invalid"], counts["navigation_gaps"]) == (9, 3, 3), err
    store = FrameStore(tmp_path / "store")
    frames = [decode_frame(store.read(stored.frame_id)) for stored in store.frames]
    assert [f.pose.source for f in frames] == ["navigation"] * 3 + ["none"] * 3 + ["navigation"] * 3
    assert [f.pose.valid for f in frames] == [True] * 3 + [False] * 3 + [True] * 3
    truth = pose_tag(mission, frames[7].mid_exposure_utc_ns)
    assert np.linalg.norm(frames[7].pose.position_body_m - truth.position_body_m) < 2e-3
    np.testing.assert_allclose(frames[7].pose.covariance, np.eye(6) * 1e-4, atol=1e-12)


def test_frames_outside_the_ephemeris_are_kept_without_a_pose(tmp_path, small_mission):
    """DE421 ends in 2053; the camera does not mind."""
    from flightsw.cameras.camera import Exposure
    from flightsw.capture.sequencer import capture

    class Clock:
        has_own_clock = True

        def expose(self, exposure_time_s: float, start_utc_ns: int) -> Exposure:
            shape = (small_mission.camera.height, small_mission.camera.width)
            return Exposure(
                np.full(shape, 70, np.uint16), exposure_time_s, start_utc_ns + 30 * 365 * 86_400 * 10**9
            )

        def close(self) -> None:
            pass

    mission = dataclasses.replace(small_mission, bracket=dataclasses.replace(small_mission.bracket, count=1))
    store = FrameStore(tmp_path / "store")
    counts = capture(mission, Clock(), store)
    assert (counts.stored, counts.pose_invalid, counts.outside_ephemeris, counts.failed) == (3, 3, 3, 0)
    assert decode_frame(store.read(0)).pose.source == "none"
