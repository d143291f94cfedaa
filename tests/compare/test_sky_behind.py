"""What conditions put behind the target: the Earth, and stars."""

import numpy as np
import pytest
import torch

from compare.case import Case, load_case
from compare.conditions import Condition, given
from obbgs_base.physics.earth import camera_rays, sees_earth
from tests.small_sessions import small_session


@pytest.fixture(scope="module")
def case(tmp_path_factory) -> Case:
    return load_case(small_session(tmp_path_factory.mktemp("sessions") / "target"))


def frames_under(case: Case, **changes):
    return given(case, Condition(noise=1e-6, **changes))[0]


def test_the_earth_is_behind_the_target_of_its_share_of_the_frames(case):
    view, affected = case.true_views(), 0
    for plain, frame in zip(frames_under(case), frames_under(case, earth=0.5), strict=True):
        if frame.earth_m is None:
            assert torch.equal(frame.dn, plain.dn)
            continue
        affected += 1
        height, width = frame.dn.shape[:2]
        rays = camera_rays(frame.K.double().numpy(), width, height)
        earth = torch.from_numpy(sees_earth(rays, -frame.earth_m.double().numpy()))
        coverage = torch.from_numpy(view(frame)[1])
        added = (frame.dn - plain.dn)[..., 0]
        assert added[(coverage == 1) | ~earth].abs().max() <= 1.5  # rounding of both
        assert added[earth & (coverage == 0)].max() > 20  # and it is day
    assert affected == pytest.approx(len(case.training) / 2, abs=1.5)
    assert all(frame.earth_m is not None for frame in frames_under(case, earth=1.0))


def test_each_frame_has_an_earth_of_its_own_and_every_method_the_same(case):
    frames, again = frames_under(case, earth=1.0), frames_under(case, earth=1.0)
    assert all(torch.equal(a.dn, b.dn) for a, b in zip(frames, again, strict=True))
    assert len({tuple(frame.earth_m.tolist()) for frame in frames}) == len(frames)


def test_stars_of_magnitude_6_read_what_the_condition_says(case):
    """About one star in 5,000 / 10^(0.51) is between magnitudes 5 and 6; the faintest of magnitude 9 are far below."""
    noise_dn, longest_s = case.sensor.read_noise_dn, max(f.exposure_time_s for f in case.training)
    view, found = case.true_views(), []
    for plain, frame in zip(frames_under(case), frames_under(case, stars=20), strict=True):
        sky = torch.from_numpy(view(frame)[1]) == 0
        added = (frame.dn - plain.dn)[..., 0][sky] * (longest_s / frame.exposure_time_s)
        found.append((added > 20 * noise_dn).sum() / sky.sum())
    frame = case.training[0]
    solid_angle = frame.dn.shape[0] * frame.dn.shape[1] / float(frame.K[0, 0] * frame.K[1, 1])
    expected = 5000 / (4 * np.pi) * solid_angle / (frame.dn.shape[0] * frame.dn.shape[1])
    assert float(np.mean(found)) == pytest.approx(expected, rel=0.5)  # some share a pixel
