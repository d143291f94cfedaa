"""`ground view`: which run it shows, who may connect, what colours mean, and its page in a browser."""

import contextlib
import dataclasses
import json
import math
import queue
import shutil
import socket
import threading
import time
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import torch
import trimesh
from typer.testing import CliRunner
from websockets.datastructures import Headers
from websockets.http11 import Request
from websockets.sync.client import connect

from ground import cli
from ground.cameras import predicted_image
from ground.live import reconstruct_live
from ground.pictures import tone
from ground.session import SessionError
from ground.viewer import splats, viewer
from ground.viewer.door import ViewError, opened, refused
from ground.viewer.scene import Placed
from ground.viewer.source import Shown, Source
from obbgs_base.errors import Interrupted
from obbgs_core.io.mesh import save_mesh
from obbgs_core.io.ply import load_ply, save_ply
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.mesh import SurfaceMesh
from obbgs_core.render import render
from tests import scenes
from tests.browser import chromium
from tests.browser import opened as page_of
from tests.small_sessions import small_session

# viser 1.1.1 prints it for any splats, at times: the empty bounding sphere of a geometry that it has not filled yet
VISERS = "computeBoundingSphere(): Computed radius is NaN"


@pytest.fixture(scope="module")
def session(tmp_path_factory) -> Path:
    """A session of 40x40 pixels, and a run whose model is the one that was photographed."""
    folder = small_session(tmp_path_factory.mktemp("viewed") / "A")
    run = folder / "runs" / "run"
    run.mkdir(parents=True)
    save_ply(scenes.target(), run / "model.ply")
    return folder


def test_a_run_is_found_by_its_folder_or_its_session_and_read_again_when_renewed(session, tmp_path):
    folder = tmp_path / "copy"
    shutil.copytree(session, folder)
    shutil.copytree(folder / "runs" / "run", folder / "runs" / "newer")
    save_ply(scenes.target(seed=1), folder / "runs" / "newer" / "model.ply")
    assert Source(folder / "runs" / "run").name == "copy/run"
    source = Source(folder)
    assert source.folder is not None and source.folder.name == "newer" and source.renewed()
    assert len(source.load().gaussians) == 60 and not source.renewed()
    save_ply(scenes.target(count=70), source.folder / "model.ply")
    assert source.renewed() and len(source.load().gaussians) == 70
    (source.folder / "model.ply").unlink()
    assert not source.renewed()  # between two models
    with pytest.raises(SessionError, match=r"has no model\.ply yet"):
        source.load()


def test_what_is_no_run_is_told_so(session, tmp_path):
    with pytest.raises(SessionError, match=r"neither a session \(session\.json\) nor a run"):
        Source(tmp_path)
    with pytest.raises(SessionError, match=r"neither a session \(session\.json\) nor a run"):
        Source(session / "frames" / "live")
    shutil.copytree(session / "runs" / "run", tmp_path / "alone")
    with pytest.raises(SessionError, match=r"does not lie in runs/ of a session"):
        Source(tmp_path / "alone")


def test_a_run_that_is_yet_to_come_is_waited_for(session, tmp_path):
    folder = tmp_path / "s"
    shutil.copytree(session, folder, ignore=shutil.ignore_patterns("runs"))
    for path in (folder, folder / "runs" / "live"):
        source = Source(path)
        assert not source.is_ready() and not source.renewed()
        shutil.copytree(session / "runs" / "run", folder / "runs" / "live")
        assert source.is_ready() and source.renewed() and source.name == "s/live"
        shutil.rmtree(folder / "runs")


def test_the_page_waits_for_the_first_model_of_a_growing_run_and_follows_it(session, tmp_path):
    """In the browser: what is waited for, frames as they come, then the splats that a real training shows."""
    folder = tmp_path / "pass"
    shutil.copytree(session, folder, ignore=shutil.ignore_patterns("runs", "frames.jsonl"))
    lines, stop = (session / "frames.jsonl").read_text().splitlines(keepends=True), threading.Event()

    def arrive(count: int) -> None:
        with open(folder / "frames.jsonl", "a") as index:
            index.writelines(lines[:count])
        del lines[:count]

    def train() -> None:
        with contextlib.suppress(Interrupted):
            reconstruct_live(folder, changes={"steps": 60, "start.count": 400}, should_stop=stop.is_set)

    ports = queue.Queue()
    sources = [Source(folder / "runs" / "live")]
    shown = threading.Thread(target=viewer.view, args=(sources, "127.0.0.1", 0, ports.put, stop.is_set))
    trained = threading.Thread(target=train)
    shown.start()
    try:
        with chromium() as browser, page_of(browser, f"http://127.0.0.1:{ports.get()}", known=VISERS) as page:
            page.wait_for_selector("text=Waiting for the first model of pass/live.")
            page.wait_for_selector("text=0 frames have come.")
            arrive(3)
            page.wait_for_selector("text=3 frames have come.")
            trained.start()
            page.wait_for_selector("text=4 brackets are needed to begin")
            arrive(9)
            page.wait_for_selector("text=Timeline of the pass")
            assert page.get_by_text("have come").count() == 0
            gaussians = len(load_ply(folder / "runs" / "live" / "model.ply"))
            page.wait_for_selector(f"text={gaussians:,} Gaussians")
            page.get_by_text("Look through its camera").click()
            page.wait_for_timeout(3000)  # the splats fade in
            with_splats = screenshot(page)
            page.get_by_text("Splats", exact=True).click()
            page.wait_for_timeout(1000)
            assert np.abs(with_splats - screenshot(page)).max() > 50
    finally:
        stop.set()
        shown.join()
        if trained.ident is not None:  # no browser: skipped before it was started
            trained.join()


@pytest.mark.parametrize(
    ("host", "headers", "told"),
    [
        ("127.0.0.1", {"Host": "127.0.0.1:80", "Origin": "http://127.0.0.1:80"}, None),
        ("127.0.0.1", {"Host": "localhost:80", "Origin": "http://localhost:80"}, None),
        ("127.0.0.1", {"Host": "127.0.0.1:80", "Origin": "http://evil.example"}, "only the page"),
        ("127.0.0.1", {"Host": "127.0.0.1:80", "Origin": "http://127.0.0.1:81"}, "only the page"),
        ("127.0.0.1", {"Host": "127.0.0.1:80"}, "only the page"),
        ("127.0.0.1", {"Host": "evil.example:80", "Origin": "http://evil.example:80"}, "this machine only"),
        ("127.0.0.1", {}, "this machine only"),
        ("0.0.0.0", {"Host": "station:80", "Origin": "http://station:80"}, None),
        ("0.0.0.0", {"Host": "station:80", "Origin": "http://evil.example"}, "only the page"),
    ],
)
def test_only_the_page_of_the_server_may_connect(host, headers, told):
    reason = refused(Request("/", Headers(headers | {"Upgrade": "websocket"})), host)
    assert (reason is None) if told is None else (told in str(reason))


def test_a_page_of_another_site_gets_nothing_from_the_port():
    server = opened("127.0.0.1", 0)
    try:
        url = f"ws://127.0.0.1:{server.get_port()}"
        with pytest.raises(Exception, match="403"):
            connect(url, origin="http://evil.example")  # pyright: ignore[reportArgumentType]
    finally:
        server.stop()


def test_a_port_that_is_taken_is_not_replaced_by_another(session):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(ViewError, match=f"cannot listen on 127.0.0.1 port {port}: .*--port"):
            opened("127.0.0.1", port)
    result = CliRunner().invoke(cli.app, ["view", str(session / "nothing")])
    assert result.exit_code == 1 and "neither a session" in str(result.exception)


def solid(footprint: str) -> Gaussians:
    """Return the opaque surface of a sphere of 0.9 m, as trained models have surfaces, with light and dark places."""
    rng = torch.Generator().manual_seed(0)
    means = torch.nn.functional.normalize(torch.randn(1500, 3, generator=rng), dim=1)
    light = 0.25 + 0.2 * torch.sin(4 * means[:, 0]) * torch.sin(3 * means[:, 2])
    return Gaussians(
        0.9 * means,
        torch.tensor([[1.0, 0, 0, 0]]).repeat(1500, 1),
        torch.full((1500, 3), 0.05).log(),
        torch.full((1500,), 3.0),
        scenes.from_radiance(light[:, None, None]),
        footprint=footprint,  # pyright: ignore[reportArgumentType]
    )


def as_drawn(shown: Shown, record, exposure_time_s: float) -> np.ndarray:
    """Return what a program draws that blends the viewer's colours, here our own renderer, as bytes [H, W, 3]."""
    shape = splats.shapes(shown)
    values, vectors = np.linalg.eigh(shape.covariances)
    vectors[np.linalg.det(vectors) < 0, :, 0] *= -1
    from scipy.spatial.transform import Rotation

    rgb = splats.colours(shown, record, exposure_time_s) / 255
    blended = Gaussians(
        torch.from_numpy(shape.means),
        torch.from_numpy(Rotation.from_matrix(vectors).as_quat(scalar_first=True)).float(),
        torch.from_numpy(np.log(values) / 2).float(),
        torch.logit(torch.from_numpy(shape.opacities), eps=1e-6),
        scenes.from_radiance(torch.from_numpy(rgb).float()[:, None]),
        footprint="mip-splatting",
    )
    cameras = splats.cameras_of(shown.session, [record])
    K = cameras.K * torch.tensor([[8.0], [8.0], [1.0]])  # a screen is finer than the sensor
    fine = dataclasses.replace(cameras, K=K, width=8 * cameras.width, height=8 * cameras.height)
    image = render(blended, fine).radiance[0].numpy()
    return image.reshape(cameras.height, 8, cameras.width, 8, 3).mean(axis=(1, 3)) * 255


@pytest.mark.parametrize("footprint", ["kerbl", "camera"])
def test_shapes_and_colours_give_the_picture_of_the_sensor(session, footprint):
    """Display colours are blended in place of light, which is the larger part of the difference."""
    shown = dataclasses.replace(Source(session).load(), gaussians=solid(footprint))
    record = shown.session.frames[3]
    image = predicted_image(shown.gaussians, shown.session, record, shown.sensor, record.exposure_time_s)
    ours = tone(image.numpy(), shown.sensor, "linear").astype(float)
    theirs = as_drawn(shown, record, record.exposure_time_s)
    assert ours.max() > 100
    assert -10 * np.log10(np.mean((ours - theirs) ** 2) / 255**2) > 30


def test_the_misfit_is_seen_where_the_model_is_wrong(session):
    """One Gaussian is made four times as bright: it gets the brightest colour, those of the others stay dark."""
    shown = Source(session).load()
    before = splats.error_colours(shown).astype(int).sum(axis=1)
    wrong = shown.gaussians.detach()
    sh = wrong.sh.clone()
    index = int(wrong.means.norm(dim=1).argmax())  # stands alone
    sh[index] *= 4
    shown = dataclasses.replace(shown, gaussians=dataclasses.replace(wrong, sh=sh))
    after = splats.error_colours(shown).astype(int)
    np.testing.assert_allclose(after[index], splats.RAMP[-1], atol=60)
    assert np.median(before) < splats.RAMP[2].sum() < after[index].sum()


def test_uncertainty_is_larger_for_what_frames_show_less(session):
    shown = Source(session).load()
    hidden = shown.gaussians.detach()
    logits = hidden.opacity_logits.clone()
    logits[7] = -9.0  # nearly transparent: the frames say nothing of its radiance
    shown = dataclasses.replace(shown, gaussians=dataclasses.replace(hidden, opacity_logits=logits))
    colour = splats.uncertainty_colours(shown).astype(int)
    np.testing.assert_allclose(colour[7], splats.RAMP[-1], atol=1)
    assert colour[:7].sum(axis=1).max() < colour[7].sum()


def test_the_page_draws_the_splats_and_its_controls_work(session):
    """What the browser draws through a frame's camera against our renderer: on black, at two exposures."""
    shown = dataclasses.replace(Source(session).load(), gaussians=solid("camera"))
    server = opened("127.0.0.1", 0)
    try:
        first = Placed(server, "a", shown, np.zeros(3))
        second = Placed(server, "b", shown, np.array([24.0, 0, 0]), first.per_metre)
        page_viewer = viewer.Viewer(server, [first, second])
        second.show("splats", False)  # it stands in the picture that is compared
        with (
            chromium() as browser,
            page_of(browser, f"http://127.0.0.1:{server.get_port()}", 700, 700, known=VISERS) as page,
        ):
            page.wait_for_selector("text=Timeline of the pass")
            client = waited_for(lambda: next(iter(server.get_clients().values()), None))
            page.get_by_text("0.2", exact=True).click()
            waited_for(lambda: page_viewer.exposure_s == pytest.approx(2e-4))
            page.get_by_text("Look through its camera").click()
            waited_for(lambda: abs(client.camera.fov - 2 * np.arctan(20 / 80)) < 1e-3)
            waited_for(lambda: abs(np.linalg.norm(client.camera.position) - 8 * first.per_metre) < 1)
            page.wait_for_timeout(3000)  # the splats fade in
            for exposure_s in (2e-4, 5e-5):
                page_viewer.exposure.value = 1e3 * exposure_s
                page_viewer.draw_splats()
                theirs, ours = through_camera(client, first, page_viewer.record, exposure_s)
                assert ours.max() > 50
                assert -10 * np.log10(np.mean((ours - theirs) ** 2) / 255**2) > 30
            page.get_by_text("Cameras", exact=True).click()
            waited_for(lambda: all(handle.visible for handle in first.handles["cameras"]))
            page.get_by_text("Save turntable").click()
            page.wait_for_selector("text=turntable.png")
    finally:
        server.stop()


def test_the_mesh_covers_what_the_splats_cover(session):
    """In the browser: silhouettes of three arms, each of another length, as splats and as our mesh of the same arms."""
    rng, arms = np.random.default_rng(0), []
    for axis, length_m in enumerate((0.8, 1.6, 2.6)):
        size_m = np.full(3, 0.4)
        size_m[axis] = length_m
        arms.append(trimesh.creation.box(size_m, transform=translation(axis, length_m / 2)))
    points = torch.from_numpy(np.concatenate([rng.uniform(*arm.bounds, (800, 3)) for arm in arms])).float()
    model = dataclasses.replace(
        scenes.ball(len(points), 0.0, math.log(0.03), 0.0),
        means=points,
        opacity_logits=torch.full((len(points),), 3.0),
    )
    solid_arms = trimesh.util.concatenate(arms)
    grey = np.full((len(solid_arms.vertices), 1), 0.5, np.float32)
    seen = np.ones(len(grey), np.int64)
    mesh = SurfaceMesh(np.asarray(solid_arms.vertices), np.asarray(solid_arms.faces), grey, seen, 1, False)
    path = session / "arms.glb"
    save_mesh(mesh, path, 1.0)
    shown = dataclasses.replace(Source(session).load(), gaussians=model, mesh=path.read_bytes())
    server = opened("127.0.0.1", 0)
    try:
        placed = Placed(server, "a", shown, np.zeros(3))
        page_viewer = viewer.Viewer(server, [placed])
        with (
            chromium() as browser,
            page_of(browser, f"http://127.0.0.1:{server.get_port()}", 400, 400, known=VISERS) as page,
        ):
            page.wait_for_selector("text=Timeline of the pass")
            client = waited_for(lambda: next(iter(server.get_clients().values()), None))
            client.camera.position, client.camera.look_at = (40.0, 48.0, 26.0), (0.0, 0.0, 0.0)
            page.wait_for_timeout(3000)  # the splats fade in
            covered = {}
            for part, other in (("splats", "mesh"), ("mesh", "splats")):
                page_viewer.checks[other].value, page_viewer.checks[part].value = False, True
                page.wait_for_timeout(500)
                covered[part] = drawn(client)
    finally:
        server.stop()
    splats_, mesh_ = covered["splats"], covered["mesh"]
    # splats have soft edges, 0.83 of them lie on the mesh; of a mesh that is turned by a quarter 0.54 and 0.41 do
    assert (splats_ & mesh_).sum() / mesh_.sum() > 0.9 and (splats_ & mesh_).sum() / splats_.sum() > 0.7


def drawn(client) -> np.ndarray:
    """Return which pixels of a client's picture [200, 200] are covered, as soon as something is drawn."""
    covered = np.zeros((200, 200), bool)

    def draws() -> bool:
        covered[:] = client.get_render(200, 200, transport_format="png", timeout=200)[..., 3] > 200
        return bool(covered.any())

    waited_for(draws)
    return covered


def translation(axis: int, by_m: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[axis, 3] = by_m
    return matrix


def test_controls_follow_a_run_that_gets_a_mesh_and_frames_of_other_exposures(session, tmp_path):
    """In the browser: what a live run shows at first, when it has ended, and when it is made again."""
    folder = tmp_path / "pass"
    shutil.copytree(session, folder)
    index, run = folder / "frames.jsonl", folder / "runs" / "run"
    lines = [json.loads(line) for line in index.read_text().splitlines()]

    def commanded(scale: float, count: int) -> None:
        """Let all frames after the first 12 have exposure times of their own, as far as there are so many."""
        for number, line in enumerate(lines[12:]):
            line["exposure_time_s"] = scale * 1e-3 * 1.01**number
        index.write_text("".join(json.dumps(line) + "\n" for line in lines[:count]))

    commanded(2.0, 12)
    server, source = opened("127.0.0.1", 0), Source(run)
    try:
        shown = viewer.Viewer(server, [Placed(server, "a", source.load(), np.zeros(3))])
        assert shown.brackets.options == ("0.05", "0.1", "0.2")
        with (
            chromium() as browser,
            page_of(browser, f"http://127.0.0.1:{server.get_port()}", known=VISERS) as page,
        ):
            page.wait_for_selector("text=Timeline of the pass")
            mesh = page.get_by_text("Mesh", exact=True)
            assert mesh.count() == 0
            commanded(2.0, 24)
            trimesh.creation.icosphere(radius=1.5).export(run / "model.glb")
            assert source.renewed()
            shown.renew(0, source)
            mesh.wait_for()
            assert len(shown.brackets.options) == 6 and shown.brackets.options[0] == "0.05"
            assert shown.exposure_s == pytest.approx(1e-4)  # as it was chosen
            longest = shown.brackets.options[-1]
            page.get_by_text(longest, exact=True).click()
            waited_for(lambda: shown.exposure_s == pytest.approx(2e-3 * 1.01**11))
            mesh.click()
            waited_for(lambda: [handle.visible for handle in shown.placed[0].handles["mesh"]] == [True])
            (run / "model.glb").unlink()
            commanded(0.2, 24)
            assert source.renewed()
            shown.renew(0, source)
            mesh.wait_for(state="detached")
            page.get_by_text(longest, exact=True).wait_for(state="detached")
            assert shown.exposure_s == shown.exposure.max / 1e3 == pytest.approx(4 * 2e-4 * 1.01**11)
            assert (
                shown.placed[0].handles["mesh"] == [] and "/a/mesh" not in server.scene._handle_from_node_name
            )
    finally:
        server.stop()


def test_no_arrow_points_to_the_sun_of_another_frame(session):
    shown = Source(session).load()
    known = dataclasses.replace(shown.session.frames[0], sun_dir_body=np.array([0.0, 0.6, 0.8]))
    server = opened("127.0.0.1", 0)
    try:
        placed = Placed(server, "a", shown, np.zeros(3))
        placed.draw_sun(known, True)
        assert "/a/sun" in server.scene._handle_from_node_name
        placed.draw_sun(dataclasses.replace(known, sun_dir_body=np.zeros(3)), True)
        assert not {"/a/sun", "/a/sun label"} & set(server.scene._handle_from_node_name)
    finally:
        server.stop()


def through_camera(client, placed: Placed, record, exposure_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return what a client draws through a frame's camera, and what our renderer does, bytes [H, W, 3], on black."""
    shown = placed.shown
    camera, times = shown.session.camera, 8  # a screen is finer than the sensor
    height, width = times * camera.height, times * camera.width
    drawn = client.get_render(height, width, transport_format="png", timeout=200)
    on_black = viewer.on_black(drawn).astype(float)
    theirs = on_black.reshape(camera.height, times, camera.width, times, 3).mean(axis=(1, 3))
    image = predicted_image(shown.gaussians, shown.session, record, shown.sensor, exposure_s)
    return theirs, tone(image.numpy(), shown.sensor, shown.session.encoding).astype(float)


def screenshot(page) -> np.ndarray:
    """Return what a page shows, [H, W, 3]."""
    return np.asarray(imagecodecs.png_decode(page.screenshot()))[..., :3].astype(int)


def waited_for(what, seconds: float = 100):
    """Return what a function returns, as soon as it is true; fail after some time."""
    end_s = time.monotonic() + seconds
    while not (value := what()):
        assert time.monotonic() < end_s
        time.sleep(0.1)
    return value
