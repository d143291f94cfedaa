"""The bodies that benchmarks make: closed enough to render, of the size and paint that they claim."""

import numpy as np
import pytest
import trimesh

from tests.benchmarks.bodies import BODIES

EXTENTS_M = {
    "truss": (0.6, 0.6, 4.65),
    "dark": (7.0, 1.02, 3.0),
    "sputnik": (4.4, 4.4, 2.0),
    "rocket": (1.97, 1.8, 5.8),
}


@pytest.mark.parametrize("name", BODIES)
def test_a_body_survives_its_file(name, tmp_path):
    parts = BODIES[name]()
    path = tmp_path / f"{name}.glb"
    trimesh.Scene({str(i): part for i, part in enumerate(parts)}).export(path)
    read = trimesh.load_scene(path)
    assert read.extents == pytest.approx(EXTENTS_M[name], abs=0.06)
    assert read.area == pytest.approx(sum(part.area for part in parts), rel=1e-5)
    assert all(part.is_watertight for part in parts)
    paints = {tuple(np.asarray(part.visual.material.baseColorFactor)) for part in read.geometry.values()}
    assert len(paints) == len({tuple(np.asarray(part.visual.material.baseColorFactor)) for part in parts})
