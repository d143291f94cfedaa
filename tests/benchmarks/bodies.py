"""Bodies of what the other targets lack, as binary glTF: thin struts, near-black paint, a mirror, near symmetry.

They are made, and the whole loop is flown about one of them, by

    python -m tests.benchmarks.bodies --out bodies
    hil demo --mesh bodies/truss.glb --out demo-truss
"""

import argparse
from pathlib import Path

import numpy as np
import trimesh
from trimesh import Trimesh
from trimesh.transformations import translation_matrix
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

Colour = tuple[float, float, float]
Point = tuple[float, float, float]


def truss() -> list[Trimesh]:
    """Return a boom of 96 struts, 4 m long, each 1.6 or 2.4 cm thin, between two boxes."""
    bays, length = 8, 4.0
    corners = ((0.15, 0.15), (0.15, -0.15), (-0.15, -0.15), (-0.15, 0.15))
    parts = []
    for bay in range(bays):
        low, high = bay * length / bays - 2, (bay + 1) * length / bays - 2
        for here, there in zip(corners, corners[1:] + corners[:1], strict=True):
            parts += [
                _rod((*here, low), (*here, high), 0.012, (0.8, 0.8, 0.8)),
                _rod((*here, low), (*there, high), 0.008, (0.7, 0.7, 0.6)),
                _rod((*here, high), (*there, high), 0.008, (0.7, 0.7, 0.6)),
            ]
    ends = (
        _box((0.6, 0.6, 0.5), (0, 0, -2.2), (0.5, 0.45, 0.3)),
        _box((0.3, 0.3, 0.2), (0, 0, 2.1), (0.9, 0.9, 0.9)),
    )
    return [*parts, *ends]


def dark() -> list[Trimesh]:
    """Return a box and two panels that reflect 2 to 6 % of the light, with one bright stripe."""
    return [
        _box((1, 1, 3), (0, 0, 0), (0.03, 0.03, 0.035)),
        _box((3, 0.02, 1), (2, 0, 1), (0.02, 0.02, 0.06)),
        _box((3, 0.02, 1), (-2, 0, 1), (0.02, 0.02, 0.06)),
        _box((0.2, 1.02, 2.9), (0.2, 0, 0), (0.9, 0.9, 0.9)),
    ]


def sputnik() -> list[Trimesh]:
    """Return a polished sphere with four antennas."""
    ball = _painted(trimesh.creation.icosphere(4, 1.0), (0.9, 0.9, 0.9), metallic=1.0, roughness=0.15)
    turns = np.arange(4) * np.pi / 2
    tips = [(2.2 * float(np.cos(turn)), 2.2 * float(np.sin(turn)), 1.0) for turn in turns]
    return [ball, *(_rod((0, 0, 0), tip, 0.02, (0.8, 0.8, 0.8)) for tip in tips)]


def rocket() -> list[Trimesh]:
    """Return a stage with its nozzle, alike from all sides but for one dark strip."""
    nozzle = trimesh.creation.cone(0.7, 1.2, sections=48)
    nozzle.apply_translation([0, 0, -3.3])
    return [
        _painted(trimesh.creation.cylinder(0.9, 5, sections=48), (0.85, 0.85, 0.83)),
        _painted(nozzle, (0.3, 0.3, 0.32), metallic=1.0, roughness=0.4),
        _box((0.3, 0.1, 1.5), (0.92, 0, 0.5), (0.1, 0.1, 0.1)),
    ]


BODIES = {make.__name__: make for make in (truss, dark, sputnik, rocket)}


def _box(extents: Point, centre: Point, colour: Colour) -> Trimesh:
    return _painted(trimesh.creation.box(extents, translation_matrix(centre)), colour)


def _rod(start: Point, end: Point, radius: float, colour: Colour) -> Trimesh:
    return _painted(trimesh.creation.cylinder(radius, segment=[start, end], sections=10), colour)


def _painted(mesh: Trimesh, colour: Colour, metallic: float = 0.0, roughness: float = 0.9) -> Trimesh:
    paint = PBRMaterial(baseColorFactor=[*colour, 1.0], metallicFactor=metallic, roughnessFactor=roughness)
    mesh.visual = TextureVisuals(uv=np.zeros((len(mesh.vertices), 2)), material=paint)
    return mesh


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for NAME.glb")
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    for name, make in BODIES.items():
        trimesh.Scene({str(i): part for i, part in enumerate(make())}).export(out / f"{name}.glb")
        print(out / f"{name}.glb")


if __name__ == "__main__":
    main()
