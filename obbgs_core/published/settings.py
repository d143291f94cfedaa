"""The settings in which published methods differ from `obbgs`; at the defaults nothing is otherwise."""

from dataclasses import dataclass
from typing import Literal

from obbgs_core.model.gaussians import Footprint
from obbgs_core.settings import check, fraction, number


@dataclass(frozen=True)
class PublishedSettings:
    """What a published method does otherwise; sources are in docs/method.md, "Published methods".

    Raises:
        ValueError: a value is out of its range; the message names the setting, such as `published.coarse`.
    """

    # target: its radius as the silhouettes show it; cameras: the extent of the cameras (3DGS)
    length_unit: Literal["target", "cameras"] = "target"
    # of the rate of the radiance coefficients. full_scale: what saturates a pixel at the frames' mean exposure time, as
    # where pictures of 0 to 1 are fitted (3DGS); one: radiance as it is
    radiance_unit: Literal["one", "full_scale"] = "one"
    # the frames of a step are one of each exposure time (001; within the scatter: 076), or any (3DGS)
    bracket_steps: bool = True
    windows: bool = True  # only the part of each frame that the target lies in is rendered and compared
    footprint: Footprint = "camera"  # what a pixel averages over, see `Gaussians`
    # first radiance: grey, half of full scale and a little at random (3DGS without a point cloud), or as frames show it
    grey_start: bool = False
    loss: Literal["l1_ssim", "likelihood"] = "likelihood"
    ssim_weight: float = fraction(0.2)  # of l1_ssim: the share of SSIM in it (3DGS)
    # of l1_ssim: the prediction is clamped at full scale as the sensor clips, so that a saturated pixel does not pull
    clamped: bool = True
    sh_degree: int = number(0, most=3)  # of the spherical harmonics at the start
    # above 0: only degree 0 is trained at first, and one degree more after each such number of steps (3DGS)
    sh_interval: int = 0
    # (image scale, frames of a step, share of the steps) of trainings that come first and hand over their model; each
    # counts its steps from 0, so that the rate of the means and growth begin again (MVGS)
    coarse: tuple[tuple[float, int, float], ...] = ()
    # above 0: variance, px², of the 3D filter that keeps Gaussians as wide as the pictures sample (Mip-Splatting)
    smoothing_px2: float = 0.0
    compensation: bool = False  # an affine map of the colours of each training frame is learnt (later 3DGS)
    outlier_filter: bool = (
        False  # remove Gaussians far from the centre from the finished model (Jiang et al. 2025)
    )
    recorded_from_start: bool = False  # screen gradients are recorded before growth begins, too (3DGS)
    # what grows becomes: a clone where it is small and two drawn from it where it is large (random: 3DGS), or always
    # two beside each other on its longest axis
    split: Literal["random", "long_axis"] = "long_axis"
    pixel_weighted: bool = True  # gradients are averaged over pixels (Pixel-GS) instead of views (3DGS)
    # above 0: gradients of Gaussians nearer to the camera than this count less (Pixel-GS)
    depth_scale: float = 0.0
    # densified: cloned and split where gradients are large; sampled: 3DGS-MCMC
    growth: Literal["densified", "sampled"] = "densified"
    # also clone what lies where the worst tiles of a step's views cross, and halve the threshold where two of the
    # step's cameras are far apart (MVGS)
    multi_view: bool = False
    prune_size: float = 0.2  # larger Gaussians are removed at each densification, in the unit of length
    prune_size_from: float = fraction(0.0)  # share of the steps before which size is no reason to remove
    opacity_reset_interval: int = 0  # steps between two resets of the opacities (3DGS); 0: never

    def __post_init__(self):
        check(self, "published")
        if not all(len(stage) == 3 and 0 < stage[0] <= 1 and stage[1] >= 1 for stage in self.coarse) or not (
            sum(stage[2] for stage in self.coarse) < 1
        ):
            raise ValueError(
                "published.coarse must be triples of an image scale of 0 to 1, a number of frames and a share of the "
                f"steps, of less than 1 in all, got {self.coarse}"
            )
