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
from ground.run.live.reconstruct import reconstruct_live
from ground.session.cameras import predicted_image
from ground.session.folder import FrameRecord, Session, SessionError
from ground.show.pictures import tone
from ground.show.sizes import size_deviation
from ground.show.viewer import ruler, scene, splats, viewer
from ground.show.viewer.door import ViewError, opened, refused
from ground.show.viewer.scene import UNCERTAINTY, Placed
from ground.show.viewer.source import Shown, Source
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

# What viser 1.1.1 prints: for any splats, at times, that the quad which it draws for each has no bounding sphere, since
# its corners have two coordinates (the splats are drawn, whatever their positions); for a picture in the panel, that it
# asks for its address once more when it has put the panel beside the scene. The picture is shown, at another address.
VISERS = (
    "computeBoundingSphere(): Computed radius is NaN",
    "Failed to load resource: net::ERR_FILE_NOT_FOUND",
)


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
    (tmp_path / "sat").mkdir()
    (tmp_path / "sat" / "session").symlink_to(session.resolve())
    with pytest.raises(SessionError, match=r"sat is neither a session .* of one; .*sat/session is one$"):
        Source(tmp_path / "sat")


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
            page.wait_for_selector("text=0 frames received.")
            arrive(3)
            page.wait_for_selector("text=3 frames received.")
            trained.start()
            page.wait_for_selector("text=4 brackets are needed to begin")
            arrive(9)
            page.wait_for_selector("text=Timeline of the pass")
            assert page.get_by_text("frames received").count() == 0
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
    with pytest.raises(ViewError, match=r"cannot listen on nowhere\.invalid: .*--host"):
        opened("nowhere.invalid", 0)
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
        for placed in (first, second):
            placed.show("name", False)  # these do too
        with (
            chromium() as browser,
            # beside the panel 700 x 700 pixels are left, a square as the frame
            page_of(browser, f"http://127.0.0.1:{server.get_port()}", 1024, 700, known=VISERS) as page,
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
            page.get_by_text("Reset view", exact=True).click()
            waited_for(lambda: (client.camera.near, client.camera.far) == pytest.approx((0.01, 1000.0)))
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
    vertices, triangles = np.asarray(solid_arms.vertices), np.asarray(solid_arms.faces)
    texture, corners = np.full((2, 2, 1), 0.5, np.float32), np.full((len(triangles), 3, 2), 0.5, np.float32)
    mesh = SurfaceMesh(vertices, triangles, grey, seen, 1, False, corners, texture)
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
        shown.exposure.value = 0.1
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


@pytest.fixture
def bare(session):
    """A server with the ball of `solid` in its scene, and the viewer of it."""
    shown = dataclasses.replace(Source(session).load(), gaussians=solid("camera"))
    server = opened("127.0.0.1", 0)
    try:
        yield viewer.Viewer(server, [Placed(server, "a", shown, np.zeros(3))])
    finally:
        server.stop()


def test_the_ruler_measures_a_ball_along_its_diameter(bare):
    """The ball has a radius of 0.9 m; rays along x and against it strike its two sides."""
    placed = bare.placed[0]
    far = np.array([5 * placed.per_metre, 0.0, 0.0])
    middle = placed.place(np.zeros(3))
    ends = [ruler.struck(placed, middle + sign * far, -sign * far) for sign in (1, -1)]
    assert ends[0] is not None and ends[1] is not None
    np.testing.assert_allclose(ends[0], [0.9, 0, 0], atol=0.1)  # the Gaussians are 0.05 m wide
    np.testing.assert_allclose(ends[1], [-0.9, 0, 0], atol=0.1)
    assert ruler.struck(placed, middle + far + [0, 2 * placed.per_metre, 0], -far) is None
    assert bare.ruler.click(bare.placed, middle + far, -far) == "click on the second point"
    told = bare.ruler.click(bare.placed, middle - far, far)
    assert "± " in told and float(told.split()[0]) == pytest.approx(1.8, abs=0.2)
    assert "/ruler/length" in bare.server.scene._handle_from_node_name
    bare.ruler.clear()
    assert "/ruler/length" not in bare.server.scene._handle_from_node_name


def test_the_stated_error_of_sizes_is_that_of_the_ranges(session):
    """Independent range errors average out over the brackets, those that all tags share do not."""
    shown = Source(session).load()

    def stated(correlation_time_s: float) -> float:
        records = tuple(
            dataclasses.replace(r, covariance=np.diag([0.08, 0.08, 0.08, 0, 0, 0]) ** 2)
            for r in shown.session.frames
        )
        navigation = dataclasses.replace(shown.session.navigation, correlation_time_s=correlation_time_s)
        tagged = dataclasses.replace(shown.tagged, frames=records, navigation=navigation)
        return size_deviation(tagged, shown.estimate)

    assert size_deviation(shown.tagged, shown.estimate) == 0  # these poses are exact
    assert stated(0.0) == pytest.approx(0.01 / 24**0.5, rel=0.02)  # 0.08 m at 8 m, in 24 brackets
    assert stated(1e12) == pytest.approx(0.01, rel=0.02)


def test_a_crop_hides_what_lies_outside_and_a_slider_at_its_end_cuts_nothing(bare):
    placed = bare.placed[0]
    handle = placed.handles["splats"][0]
    whole = np.asarray(handle.opacities).copy()
    bare.crops[0].value = (0.0, bare.crops[0].max)
    bare._crop()
    right = placed.shapes.means[:, 0] >= 0
    assert 0 < right.sum() < len(right)
    assert (np.asarray(handle.opacities)[~right] == 0).all()
    np.testing.assert_array_equal(np.asarray(handle.opacities)[right], whole[right])
    bare.crops[0].value = (bare.crops[0].min, bare.crops[0].max)
    bare._crop()
    np.testing.assert_array_equal(np.asarray(handle.opacities), whole)


def test_at_first_the_exposure_is_one_at_which_the_target_is_seen(session):
    """A model a thousand times as faint is exposed longer than any frame was, a bright one less."""
    shown = Source(session).load()
    usual_s = splats.seen_exposure_s(shown)
    assert usual_s in {record.exposure_time_s for record in shown.session.frames}
    for factor in (1e-3, 1e3):
        sensor = dataclasses.replace(shown.sensor, dn_per_radiance_s=factor * shown.sensor.dn_per_radiance_s)
        seen_s = splats.seen_exposure_s(dataclasses.replace(shown, sensor=sensor))
        assert usual_s / factor / 10 < seen_s < 10 * usual_s / factor


def test_at_first_the_frame_is_the_one_in_which_the_target_is_best_seen(session, monkeypatch):
    """All frames but one are dark, or as bright as they can be: the page begins with that one, wherever it is."""
    shown = Source(session).load()
    exposure_s = splats.seen_exposure_s(shown)
    lit = [record for record in shown.session.frames if record.exposure_time_s == exposure_s][-1]
    read = Session.dn
    for others in (shown.sensor.black_dn, shown.sensor.white_dn):

        def dn(session: Session, record: FrameRecord, others: float = others) -> np.ndarray:
            pixels = read(session, record)
            return pixels if record.bracket == lit.bracket else np.full_like(pixels, others)

        monkeypatch.setattr(Session, "dn", dn)
        assert splats.best_seen(shown, exposure_s).id == lit.id


def test_one_saturated_pixel_is_told_in_the_singular(session):
    shown = Source(session).load().session
    told = [viewer._facts(shown, dataclasses.replace(shown.frames[0], saturated=n)) for n in (1, 1200)]
    assert told[0].endswith(", 1 pixel saturated") and told[1].endswith(", 1,200 pixels saturated")


def test_imported_pictures_show_no_time_range_or_sun_that_nobody_stated(session):
    shown = Source(session).load()
    record = dataclasses.replace(
        shown.session.frames[3], sun_dir_body=np.zeros(3), mid_exposure_utc_ns=3 * 10**9
    )
    linked = dataclasses.replace(shown.session, frames_imported=None)
    assert " m" in viewer._facts(linked, record) and "00:00:03 UTC" in viewer._facts(linked, record)
    plain = tuple(dataclasses.replace(r, sun_dir_body=np.zeros(3), mid_exposure_utc_ns=r.id * 10**9,
                                      exposure_time_s=1.0) for r in shown.session.frames)  # fmt: skip
    imported = dataclasses.replace(shown.session, frames_imported=24, frames=plain)
    facts = viewer._facts(imported, plain[3])
    assert facts == f"picture 3, {plain[3].saturated:,} pixels saturated"
    server = opened("127.0.0.1", 0)
    try:
        shown = dataclasses.replace(shown, session=imported, tagged=imported)
        page = viewer.Viewer(server, [Placed(server, "a", shown, np.zeros(3))])
        assert not page.checks["sun"].visible and page.placed[0].handles["sun"] == []
        assert "ms" not in page.file_name("view") and page.file_name("view").startswith(
            f"A-run-frame{page.record.id:06d}-"
        )
        assert all(end == round(end, 2) for crop in page.crops for end in crop.value), (
            "as the panel shows them"
        )
        assert "units of the imported poses" in ruler.measured(shown, np.zeros(3), np.ones(3))
    finally:
        server.stop()


def test_two_runs_have_names_overlays_a_legend_and_a_picture_is_saved_at_once(session):
    """In the browser: no second click is needed for the file, which is named after its run, frame and exposure."""
    shown = dataclasses.replace(Source(session).load(), gaussians=solid("camera"))
    server = opened("127.0.0.1", 0)
    try:
        first = Placed(server, "a", shown, np.zeros(3))
        second = Placed(
            server, "b", dataclasses.replace(shown, name="A/other"), np.array([24.0, 0, 0]), first.per_metre
        )
        page_viewer = viewer.Viewer(server, [first, second])
        url = f"http://127.0.0.1:{server.get_port()}"
        with chromium() as browser, page_of(browser, url, 800, 600, known=VISERS) as page:
            page.get_by_text("Save picture").wait_for()
            names = [server.scene._handle_from_node_name[f"/{each}/name"] for each in "ab"]
            assert [name.text for name in names] == ["A/run", "A/other"]
            assert names[0].position[2] > 0 > names[1].position[2], "in one line long names would overlap"
            assert page.get_by_text("seen by no frame").count() == 0
            page_viewer.colouring.value = UNCERTAINTY
            page_viewer._colour_anew()
            page.get_by_text("seen by no frame").wait_for()
            with page.expect_download() as saved:
                page.get_by_text("Save picture").click()
            assert saved.value.suggested_filename == page_viewer.file_name("view-of-uncertainty of radiance")
    finally:
        server.stop()


def test_on_a_phone_the_panel_starts_folded_and_a_touch_opens_it(bare):
    """In the browser, 390 pixels wide: the model has the screen, and its controls are one touch away."""
    url = f"http://127.0.0.1:{bare.server.get_port()}"
    with chromium() as browser, page_of(browser, url, 390, 700, known=VISERS) as page:
        title = page.get_by_text("obbgs", exact=True).first
        title.wait_for()
        waited_for(lambda: title.bounding_box()["y"] > 600)
        (client,) = bare.server.get_clients().values()
        position = np.asarray(client.camera.position)
        seen = 2 * np.arctan(np.tan(client.camera.fov / 2) * client.camera.aspect)  # from left to right
        waited_for(lambda: np.linalg.norm(client.camera.position) * np.tan(seen / 2) > 1.2 * scene.RADIUS)
        np.testing.assert_allclose(
            np.cross(position, client.camera.position), 0, atol=1e-3
        )  # moved back only
        title.click()
        waited_for(lambda: title.bounding_box()["y"] < 600)


def test_a_touch_that_comes_before_the_panel_folds_itself_keeps_it_open(bare):
    url = f"http://127.0.0.1:{bare.server.get_port()}"
    # the page's look at every 300 ms for the title is kept for the test to call
    held = "const every = setInterval; setInterval = (f, ms) => ms === 300 ? (window.fold = f, 0) : every(f, ms);"
    with chromium() as browser, page_of(browser, url, 390, 700, before=held, known=VISERS) as page:
        page.get_by_text("Timeline of the pass").wait_for()
        page.mouse.click(100, 100)
        page.evaluate("window.fold()")
        page.wait_for_timeout(500)
        assert page.get_by_text("obbgs", exact=True).first.bounding_box()["y"] < 600


def test_the_panel_stands_beside_the_scene_and_the_whole_model_is_seen_beside_it(bare):
    """In the browser, 1000 pixels wide and high: the panel takes a third, and the camera goes back for what is left."""
    url = f"http://127.0.0.1:{bare.server.get_port()}"
    with chromium() as browser, page_of(browser, url, 1000, 1000, known=VISERS) as page:
        title = page.get_by_text("obbgs", exact=True).first
        title.wait_for()
        waited_for(lambda: page.locator("canvas").first.bounding_box()["width"] < 800)
        scene_box = page.locator("canvas").first.bounding_box()
        assert scene_box["x"] + scene_box["width"] <= title.bounding_box()["x"]
        (client,) = bare.server.get_clients().values()

        def is_fully_seen() -> bool:
            half = np.tan(client.camera.fov / 2) * min(1.0, client.camera.aspect)
            return client.camera.aspect < 0.8 and np.linalg.norm(client.camera.position) * half > scene.RADIUS

        waited_for(is_fully_seen)
        page.wait_for_timeout(3000)  # the splats fade in
        with page.expect_download() as saved:
            page.get_by_text("Save picture").click()
        is_ball = np.asarray(imagecodecs.png_decode(saved.value.path().read_bytes())).max(axis=-1) > 20
        across, high = (int(np.ptp(np.flatnonzero(is_ball.any(axis=axis)))) for axis in (0, 1))
        assert across > 100 and across == pytest.approx(
            high, rel=0.1
        )  # round: 1.5 times as wide in 1200 x 800
        client.camera.position = moved = np.array([0.0, 30.0, 0.0])  # by the user
        waited_for(lambda: np.allclose(client.camera.position, moved))
        page.set_viewport_size({"width": 800, "height": 1000})
        waited_for(lambda: client.camera.aspect < 0.6)
        np.testing.assert_allclose(client.camera.position, moved, atol=1e-3)


def test_two_clicks_give_a_length_and_a_page_that_is_opened_after_the_last_begins_anew(bare):
    """In the browser: the ruler by the mouse, then the page is closed and opened again."""
    url, before = f"http://127.0.0.1:{bare.server.get_port()}", bare.exposure.value
    with chromium() as browser:
        with page_of(browser, url, known=VISERS) as page:
            page.get_by_text("Ruler: click on two points").click()
            page.get_by_text("click on the first point").wait_for()
            page.wait_for_timeout(3000)
            page.mouse.click(250, 320)
            page.get_by_text("click on the second point").wait_for()
            page.mouse.click(330, 380)
            page.get_by_text("units of the imported poses").first.wait_for()
            bare.colouring.value, bare.exposure.value = UNCERTAINTY, bare.exposure.max
        waited_for(lambda: bare.colour == scene.SENSOR and not bare.measuring.value)
        assert bare.exposure.value == pytest.approx(before) and not bare.legend.visible
        assert "/ruler/length" not in bare.server.scene._handle_from_node_name
        with page_of(browser, url, known=VISERS) as page:
            page.get_by_text("Timeline of the pass").wait_for()
            assert page.get_by_text("units of the imported poses").count() == 0
