"""Pictures together with their derivatives along x and y, from renders of a grid that is shifted by half a pixel."""

import dataclasses

import torch
from torch import Tensor

from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import render
from obbgs_core.render.highlights import highlights
from obbgs_core.render.rendered import Rendered
from obbgs_core.render.shadows import sunlit_shares


@torch.no_grad()
def render_with_slopes(gaussians: Gaussians, cameras: Cameras) -> tuple[Rendered, Tensor]:
    """Return what `render` does, and the derivatives of the radiance [C, H, W, channels, 2] along x and y, per px.

    A derivative is the difference of the radiance half a pixel to both sides, rendered there. Between the pixels of the
    picture itself, which are two apart, edges and structures as thin as a pixel are smoothed away. A backdrop stays
    where it is: the derivatives are of Gaussians that move in front of it.
    """
    suns = None if gaussians.shading == "view" else cameras.known_suns()
    sunlit = sunlit_shares(gaussians, cameras.known_suns()) if gaussians.shading == "lambert" else None
    # a highlight does not depend on where the grid lies
    shine, matt = highlights(gaussians, cameras, suns, sunlit), gaussians.matt()
    slopes = []
    for axis, name in enumerate(("width", "height")):
        K = cameras.K.clone()
        K[:, axis, 2] += 0.5
        shifted = dataclasses.replace(cameras, K=K, backdrop=None, **{name: getattr(cameras, name) + 1})
        seen = render(matt, shifted, sunlit=sunlit, added=shine)
        slope = seen.radiance.diff(dim=2 - axis)
        if cameras.backdrop is not None:
            slope = slope - seen.alpha.diff(dim=2 - axis)[..., None] * cameras.backdrop
        slopes.append(slope)
    return render(matt, cameras, sunlit=sunlit, added=shine), torch.stack(slopes, dim=-1)
