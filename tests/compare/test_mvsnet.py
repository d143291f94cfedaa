"""The learned stereo network: its warp on a plane, its layout, learning on ray-cast boxes, its loader's refusals."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from compare import methods
from compare.methods import method
from compare.opponents import mvsnet
from compare.opponents.mvsnet import NetworkSettings, WeightsUnfit, load_network, reconstruct_mvsnet
from compare.opponents.mvsnet_network import MvsNet
from compare.opponents.plane_sweep import homography_terms, warp
from compare.opponents.reconstruction import Work
from compare.opponents.stereo_views import View, pixel_rays
from tests import raycast
from tests.benchmarks import train_mvsnet

TINY = NetworkSettings(sources=2, planes=16, longest_px=64)


@pytest.fixture(scope="module")
def trained():
    """A network of width 2, trained for seconds on one spacecraft, and its losses."""
    torch.manual_seed(0)
    network = MvsNet(2)
    made = train_mvsnet.examples(scenes=1, views=4, size_px=48, seed=0, crop_px=32, planes=16)
    return network, train_mvsnet.train(network, made, steps=60, seed=0, rate=5e-3), made


@pytest.fixture(scope="module")
def weights(trained, tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "tiny.pt"
    path.write_bytes(train_mvsnet.checkpoint(trained[0], "trained for a test"))
    return path


def test_features_of_a_plane_are_warped_to_where_the_plane_projects_and_carry_a_gradient():
    """At the plane's depth the warped value is the function of the body's point, at another depth it is not."""
    K = torch.tensor([[60.0, 0, 16], [0, 60, 16], [0, 0, 1]], dtype=torch.float64)
    poses = raycast.looking_at_origin(np.array([[0, 0, 1.0], [0.25, 0, 1]]), 4.0)
    rows, columns = torch.meshgrid(torch.arange(32), torch.arange(32), indexing="ij")
    rays = pixel_rays(rows, columns, K)
    lit = torch.ones(32, 32, dtype=torch.bool)
    values, views = [], []
    for pose in map(torch.from_numpy, poses):
        view = View(torch.zeros(1, 32, 32), 1.0, lit, pose, K)
        body_rays = rays @ pose[:3, :3]
        at = view.centre - body_rays * (view.centre[2] / body_rays[..., 2])[..., None]  # on the plane z = 0
        values.append((torch.sin(3 * at[..., 0]) + at[..., 1]).float())
        views.append(view)
    source = values[1][None].clone().requires_grad_()
    terms = homography_terms(rays, *views)
    depths_m = torch.tensor([4.0, 3.5])
    seen = warp(source, *terms, (1 / depths_m)[:, None, None].expand(-1, 32, 32))[0]
    middle = np.s_[6:-6, 6:-6]
    # bilinear interpolation of a smooth function, and the first camera looks along the plane's normal
    assert (seen[0] - values[0])[middle].abs().max() < 0.01
    assert (seen[1] - values[0])[middle].abs().mean() > 0.2
    seen[0].sum().backward()
    assert source.grad is not None and source.grad.abs().sum() > 100


def test_the_layout_is_that_of_the_public_version():
    """Names and shapes of a few layers of MVSNet_pytorch, at the published width."""
    state = {name: tuple(value.shape) for name, value in MvsNet().state_dict().items()}
    assert state["feature.conv2.conv.weight"] == (16, 8, 5, 5)
    assert state["feature.feature.weight"] == (32, 32, 3, 3) and state["feature.feature.bias"] == (32,)
    assert state["cost_regularization.conv0.conv.weight"] == (8, 32, 3, 3, 3)
    assert state["cost_regularization.conv5.bn.running_var"] == (64,)
    assert state["cost_regularization.conv7.0.weight"] == (64, 32, 3, 3, 3)
    assert state["cost_regularization.conv11.1.weight"] == (8,)
    assert state["cost_regularization.prob.weight"] == (1, 8, 3, 3, 3)
    # the paper's figure for these two parts is 0.34 million
    assert sum(np.prod(shape) for name, shape in state.items() if "running" not in name) == pytest.approx(
        338_000, rel=0.01
    )


def test_the_network_learns_depths(trained):
    network, losses, made = trained
    assert np.mean(losses[-8:]) < 0.6 * np.mean(losses[:8])
    # better than the mean of the true depths of each example, which no single plane can be
    with torch.no_grad():
        ours = [train_mvsnet.loss_of(network, example).item() for example in made]
    constant = []
    for example in made:
        truth = example.truth_m[example.truth_m > 0] / (example.depths_m[1] - example.depths_m[0])
        constant.append(F.smooth_l1_loss(truth.mean().expand_as(truth), truth).item())
    assert np.mean(ours) < np.mean(constant)


def test_training_again_gives_the_same_weights(trained):
    results = []
    for _ in range(2):
        torch.manual_seed(0)
        network = MvsNet(2)
        train_mvsnet.train(network, trained[2], steps=2, seed=0)
        results.append(torch.cat([p.detach().flatten() for p in network.parameters()]))
    assert torch.equal(*results)


def test_a_reconstruction_keeps_its_depth_maps_and_names_its_weights(weights, tmp_path):
    poses = raycast.looking_at_origin(raycast.directions(5, 20), 4.5)
    frames, _ = raycast.photographed(raycast.spacecraft(3), poses, 64, 120.0, samples=1)
    result = reconstruct_mvsnet(frames, raycast.SENSOR, load_network(weights), Work(tmp_path), TINY)
    assert result.figures["weights"] == "trained for a test" and result.figures["depth_maps"] == 5
    assert len(list(tmp_path.iterdir())) == 5
    network, _, _ = load_network(weights)
    views = mvsnet.prepare(frames, raycast.SENSOR, one_exposure=True)
    found = mvsnet.depth_map(network, views, [0, 1, 2], TINY)
    lit = views.views[0].lit
    assert ((found.depth_m > 0) == lit).all() and (found.confidence <= 1.0001).all()
    near_m, far_m = mvsnet.depth_range_m(views.views[0], views.radius_m)
    assert found.depth_m[lit].min() >= near_m and found.depth_m[lit].max() <= far_m


def test_weights_of_the_public_version_are_read(tmp_path):
    """It saves a network split over processors, with a refinement that its evaluation leaves out."""
    network = MvsNet(3)
    state = {f"module.{name}": value for name, value in network.state_dict().items()}
    state["module.refine_network.conv1.conv.weight"] = torch.zeros(32, 4, 3, 3)
    torch.save({"epoch": 14, "model": state}, tmp_path / "model.ckpt")
    loaded, digest, description = load_network(tmp_path / "model.ckpt")
    assert all(torch.equal(a, b) for a, b in zip(loaded.parameters(), network.parameters(), strict=True))
    assert not loaded.training and len(digest) == 64 and description == "model.ckpt, width 3"


def _without(name: str) -> dict[str, torch.Tensor]:
    return {key: value for key, value in MvsNet(2).state_dict().items() if key != name}


@pytest.mark.parametrize(
    ("kept", "message"),
    [
        (torch.zeros(3), "dictionary of tensors"),
        ({"model": {"a": 1}}, "with the keys model"),
        ({"a": torch.zeros(1)}, "not an MVSNet"),
        (_without("feature.conv3.conv.weight"), "does not fit.*feature.conv3.conv.weight"),
        (_without("") | {"feature.conv3.conv.weight": torch.zeros(4, 4, 5, 5)}, "size mismatch"),
        (_without("") | {"feature.conv3.bn.bias": torch.full((4,), torch.nan)}, "not finite"),
    ],
)
def test_other_files_are_refused(kept, message, tmp_path):
    torch.save(kept, tmp_path / "other.pt")
    with pytest.raises(WeightsUnfit, match=f"(?s){message}"):
        load_network(tmp_path / "other.pt")


def test_missing_damaged_and_executable_files_are_refused(tmp_path):
    with pytest.raises(WeightsUnfit, match="No such file"):
        load_network(tmp_path / "none.pt")
    (tmp_path / "text.pt").write_text("hello")
    with pytest.raises(WeightsUnfit, match="cannot be read as one"):
        load_network(tmp_path / "text.pt")
    torch.save(
        {"model": raycast.spacecraft(0)[0]}, tmp_path / "code.pt"
    )  # a class of ours: unpickling it would run code
    with pytest.raises(WeightsUnfit, match="cannot be read as one"):
        load_network(tmp_path / "code.pt")


def test_weights_that_do_not_fit_are_refused_before_anything_is_read(tmp_path):
    (tmp_path / "junk.pt").write_bytes(b"no checkpoint")
    with pytest.raises(ValueError, match=r"--weights: .*junk.pt: expected a PyTorch checkpoint"):
        method("mvsnet", tmp_path / "junk.pt")


def test_weights_are_read_once_for_the_digest_and_the_work_until_the_file_changes(tmp_path, monkeypatch):
    read, path = [], tmp_path / "weights.pt"

    def counted(file):
        read.append(file)
        return load_network(file)

    monkeypatch.setattr(methods, "load_network", counted)
    torch.save(MvsNet(2).state_dict(), path)
    first = method("mvsnet", path)
    assert method("mvsnet", path).stated == first.stated and len(read) == 1
    torch.save(MvsNet(3).state_dict(), path)
    assert method("mvsnet", path).stated != first.stated and len(read) == 2
