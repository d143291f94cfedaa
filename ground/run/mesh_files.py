"""The mesh of a run, written for other software."""

from pathlib import Path

import numpy as np

from ground.session.cameras import cameras_of, median_sun_direction
from ground.session.folder import FrameRecord, Session, SessionError
from obbgs_base.errors import reason
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.mesh import SurfaceMesh


def write_mesh(
    gaussians: Gaussians, session: Session, training: list[FrameRecord], path: Path, white_radiance: float
) -> dict:
    """Write a model's mesh in the format of the path's ending, and return what metrics.json says of it.

    Args:
        white_radiance: is shown as white.

    Raises:
        ExportError: the model has no surface.
        ValueError: an unknown ending.
    """
    # loaded here: scikit-image and manifold3d are needed for nothing else
    from obbgs_core.io.mesh import save_mesh
    from obbgs_core.mesh.solid import surface_mesh

    one_per_bracket = {record.bracket: record for record in training}.values()
    cameras = cameras_of(session, list(one_per_bracket))
    mesh = surface_mesh(gaussians, cameras, median_sun_direction(training))
    save_mesh(mesh, path, white_radiance)
    return {
        "mesh_triangles": len(mesh.triangles),
        "mesh_views": mesh.views,
        "mesh_unseen_share": round(unseen_share(mesh), 4),
    }


def read_mesh_points(path: Path, count: int, seed: int = 0) -> np.ndarray:
    """Return points [count, 3] m, body frame, at random places of the area of a mesh that `write_mesh` wrote as glTF.

    Raises:
        SessionError: it cannot be read.
    """
    import trimesh
    import trimesh.sample

    from obbgs_core.io.mesh import Z_UP_TO_Y_UP

    try:
        mesh = trimesh.load_scene(path).to_mesh()
        points = trimesh.sample.sample_surface(mesh, count, seed=seed)[0]
    except (
        OSError,
        ValueError,
        LookupError,
        NameError,
        TypeError,
        AttributeError,
        NotImplementedError,
    ) as error:
        raise SessionError(f"{path} is damaged: {reason(error)}") from error
    return np.asarray(points) @ Z_UP_TO_Y_UP[:3, :3]  # the inverse of a rotation is its transpose


def unseen_share(mesh: SurfaceMesh) -> float:
    """Return the share of the area whose triangles have a corner that no view sees, 0..1."""
    a, b, c = (mesh.vertices[mesh.triangles[:, i]] for i in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    unseen = (mesh.seen_by[mesh.triangles] == 0).any(axis=1)
    return float(areas[unseen].sum() / areas.sum())
