"""The bodies that benchmarks make: closed, of the size that they claim, in paint that their files keep."""

import pytest
import trimesh
from trimesh import Trimesh

from tests.benchmarks.bodies import BODIES

EXTENTS_M = {
    "truss": (0.6, 0.6, 4.65),
    "dark": (7.0, 1.02, 3.0),
    "sputnik": (4.416, 4.416, 2.0),
    "rocket": (1.97, 1.8, 5.8),
}


def paint(part: Trimesh) -> tuple:
    material = part.visual.material
    return (
        *map(int, material.baseColorFactor),
        float(material.metallicFactor),
        float(material.roughnessFactor),
    )


@pytest.mark.parametrize("name", BODIES)
def test_a_body_survives_its_file(name, tmp_path):
    parts = BODIES[name]()
    path = tmp_path / f"{name}.glb"
    trimesh.Scene({str(i): part for i, part in enumerate(parts)}).export(path)
    read = trimesh.load_scene(path)
    assert all(part.is_watertight for part in parts)
    assert read.extents == pytest.approx(EXTENTS_M[name], abs=0.02)  # antennas end in slanted discs of 2 cm
    assert read.area == pytest.approx(sum(part.area for part in parts), rel=1e-5)
    assert sorted(map(paint, read.geometry.values())) == sorted(map(paint, parts))


def test_what_is_called_a_mirror_is_one_and_what_is_called_dark_is_dark():
    ball, *antennas = map(paint, BODIES["sputnik"]())
    assert ball[4:] == (1.0, 0.15) and all(rod[4] == 0 for rod in antennas)
    *black, stripe = map(paint, BODIES["dark"]())
    assert all(max(part[:2]) <= 0.06 * 255 for part in black) and min(stripe[:3]) > 0.8 * 255
