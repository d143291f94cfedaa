"""Faults that trimesh builds into a body are found, wherever and however large the design lies."""

import dataclasses

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from obbgs_core.errors import ReconstructionError
from obbgs_core.inspect.alignment import Surface, aligned
from obbgs_core.inspect.cad import CadError, CadMesh, read_cad, sampled
from obbgs_core.inspect.faces import flat_faces, is_flat, largest_dimension
from obbgs_core.inspect.findings import Inspection, inspect
from obbgs_core.inspect.plates import Plate, Turn, is_turned, plates_of
from obbgs_core.inspect.shown import Views

PIXEL_M = 0.03
PANEL = np.array([1.0, 0.6, 0.04])


def body(panel_deg: float = 0.0, mast: bool = True) -> trimesh.Scene:
    """Return an asymmetric body: a box with a panel on one side, hinged at the box, and a mast."""
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box([0.8, 0.6, 1.0]), node_name="bus", geom_name="bus")
    panel = trimesh.creation.box(PANEL)
    panel.apply_translation([0.5, 0, 0])
    panel.apply_transform(trimesh.transformations.rotation_matrix(np.radians(panel_deg), [0, 1, 0]))
    panel.apply_translation([0.45, 0, 0.2])
    scene.add_geometry(panel, node_name="panel", geom_name="panel")
    if mast:
        box = trimesh.creation.box([0.25, 0.2, 0.4])
        box.apply_translation([-0.2, 0.1, 0.7])
        scene.add_geometry(box, node_name="mast", geom_name="mast")
    return scene


def as_cad(scene: trimesh.Scene, folder) -> CadMesh:
    path = folder / "design.glb"
    path.write_bytes(scene.export(file_type="glb"))
    return read_cad(path)


def seen(scene: trimesh.Scene, noise_px: float = 0.2) -> tuple:
    """Return a surface with noise, as samples that trimesh draws, and the solid that it is of."""
    mesh = scene.to_mesh()
    points, of = trimesh.sample.sample_surface(mesh, 12_000, seed=3)[:2]
    normals = mesh.face_normals[of]
    points = points + normals * np.random.default_rng(1).normal(size=(len(points), 1)) * noise_px * PIXEL_M
    area = np.full(len(points), mesh.area / len(points))
    surface = Surface(np.asarray(points), np.asarray(normals), area, PIXEL_M)
    cad = CadMesh(
        np.asarray(mesh.vertices), np.asarray(mesh.faces), np.zeros(len(mesh.faces), dtype=int), ("",)
    )
    return surface, sampled(cad, 0.5 * PIXEL_M)


def views() -> Views:
    """Return cameras all around, 6 m away, a pixel 3 cm wide at the body."""
    poses = []
    for turn in Rotation.random(24, rng=np.random.default_rng(5)).as_matrix():
        pose = np.eye(4)
        pose[:3, :3], pose[2, 3] = turn, 6.0
        poses.append(pose)
    K = np.array([[200.0, 0, 60], [0, 200, 60], [0, 0, 1]])
    return Views(np.array(poses), np.tile(K, (len(poses), 1, 1)), 120, 120)


def found(built: trimesh.Scene, designed: CadMesh) -> Inspection:
    surface, solid = seen(built)
    return inspect(designed, surface, solid, views())


def moved(cad: CadMesh, scale: float) -> CadMesh:
    matrix = np.eye(4)
    matrix[:3, :3] = scale * Rotation.from_euler("xyz", [40, -70, 130], degrees=True).as_matrix()
    matrix[:3, 3] = [3 * scale, -scale, 7 * scale]
    return cad.moved(matrix)


@pytest.mark.parametrize("scale", [1.0, 1000.0])
def test_a_sound_body_has_no_findings_wherever_its_design_lies(tmp_path, scale):
    result = found(body(), moved(as_cad(body(), tmp_path), scale))
    assert result.turned == [] and result.regions == []
    assert result.place.scale * scale == pytest.approx(1.0, rel=0.02)


def test_a_turned_panel_is_told_with_its_angle(tmp_path):
    result = found(body(panel_deg=12.0), moved(as_cad(body(), tmp_path), 39.37))
    (turn,) = [turn for turn in result.turns if is_turned(turn)]
    assert result.parts[turn.plate.part] == "panel"
    assert turn.interval[0] < np.radians(12.0) < turn.interval[1]


def test_a_face_of_a_box_is_no_panel(tmp_path):
    """Only what stands free can turn: the design's box comes in six faces, as designs often do."""
    scene, box = body(), trimesh.creation.box([0.8, 0.6, 1.0])
    scene.delete_geometry("bus")
    for number, facet in enumerate(box.facets):
        scene.add_geometry(
            box.submesh([facet], append=True), node_name=f"face {number}", geom_name=f"face {number}"
        )
    design = as_cad(scene, tmp_path)
    found_plates = plates_of(sampled(design, 0.7 * PIXEL_M), PIXEL_M)
    assert {design.names[plate.part] for plate in found_plates} == {"panel"}


def test_missing_and_added_parts_are_told_apart(tmp_path):
    missing = found(body(mast=False), moved(as_cad(body(), tmp_path), 2.0))
    assert {(region.kind, region.part) for region in missing.regions} == {("missing", "mast")}
    added = found(body(), moved(as_cad(body(mast=False), tmp_path), 2.0))
    assert {region.kind for region in added.regions} == {"added"}
    np.testing.assert_allclose(added.regions[0].middle, [-0.2, 0.1, 0.75], atol=0.1)


def test_sizes_are_those_of_the_box_that_trimesh_made():
    box = trimesh.Scene(trimesh.creation.box([1.2, 0.8, 0.5]))
    surface, _ = seen(box, noise_px=0.0)
    largest = flat_faces(surface)[0]
    np.testing.assert_allclose(largest.extent, [1.2, 0.8], atol=PIXEL_M)
    assert largest.area_m2 == pytest.approx(1.2 * 0.8, rel=0.05)
    diagonal, _ = largest_dimension(surface.points)
    assert diagonal == pytest.approx(np.linalg.norm([1.2, 0.8, 0.5]), abs=2 * PIXEL_M)


def test_strips_of_a_hull_that_lie_within_the_errors_of_a_plane_are_no_flat_faces():
    hull = trimesh.creation.cylinder(radius=0.6, height=1.5, sections=200)
    surface, _ = seen(trimesh.Scene(hull), noise_px=0.1)
    # what is narrower is left of the strips between others
    faces = [face for face in flat_faces(surface) if face.extent[1] > 9 * PIXEL_M]
    ends = [bool(abs(face.axes[2][2]) > 0.9) for face in faces]
    assert len(faces) > 4 and 0 < sum(ends) <= 2
    assert [is_flat(face, surface) for face in faces] == ends


def test_what_joins_a_face_and_is_narrower_does_not_make_it_longer():
    wing, yoke = trimesh.creation.box([2.0, 1.0, 0.1]), trimesh.creation.box([0.4, 0.2, 0.1])
    yoke.apply_translation([1.2, 0.1, 0])
    surface, _ = seen(trimesh.Scene([wing, yoke]), noise_px=0.0)
    largest = flat_faces(surface)[0]
    np.testing.assert_allclose(largest.extent, [2.0, 1.0], atol=PIXEL_M)
    np.testing.assert_allclose(largest.middle[:2], [0, 0], atol=PIXEL_M)
    np.testing.assert_allclose(np.abs(np.linalg.det(largest.axes)), 1)


def test_what_is_no_design_is_refused_in_a_line(tmp_path):
    with pytest.raises(CadError, match="is not there"):
        read_cad(tmp_path / "none.glb")
    (tmp_path / "broken.glb").write_bytes(b"glTF nonsense")
    with pytest.raises(CadError, match="cannot be read as a mesh"):
        read_cad(tmp_path / "broken.glb")
    (tmp_path / "packed.glb").write_bytes(b'glTF {"extensionsRequired": ["KHR_draco_mesh_compression"]}')
    with pytest.raises(CadError, match="compressed by Draco"):
        read_cad(tmp_path / "packed.glb")
    with pytest.raises(ReconstructionError, match="at least 100"):
        aligned(as_cad(body(), tmp_path), Surface(np.zeros((3, 3)), np.zeros((3, 3)), np.ones(3), PIXEL_M))


@pytest.mark.parametrize(
    ("degrees", "significance", "found", "turned"),
    [  # as seen on TDRS and ACE
        (10.9, 2.98, 1.0, True),  # turned by 13.3 degrees
        (12.0, 6.20, 0.99, True),
        (3.9, 1.84, 1.0, False),
        (12.1, 4.21, 0.74, False),  # a dish that the model shows in part
        (1.5, 8.0, 1.0, False),  # too little to be a fault
    ],
)
def test_panels_that_lie_well_on_the_surface_are_told_as_turned_by_fewer_deviations(
    degrees, significance, found, turned
):
    plate = Plate(0, np.arange(1), np.arange(1), np.zeros(3), np.eye(3), np.ones(3))
    tilt = np.radians(degrees)
    told = Turn(plate, np.eye(4), tilt, np.eye(3)[0], (0.0, 2 * tilt), significance, found, 0.9)
    assert is_turned(told) == turned
    assert not is_turned(
        dataclasses.replace(told, left=1.5)
    )  # it lay nearer to the surface where it should be
