"""Renders one mesh with Blender, in whose own Python it runs: it imports bpy, NumPy, the standard library, and its
neighbours `blender_materials` and `crinkles`, which do the same.

Requests come on stdin and replies go to stdout, each one JSON object in a line; arrays go to the .npz file that the
request names. `render` gives scene-linear radiance, and `geometry` depth and normals: these need a render of their own
with one ray through each pixel's centre, since with many samples the depth is that of a random point of the pixel.
The settings were chosen by measurement with bpy 4.5.15 (Cycles, CPU). Blender 4.3 traces the same rays, bpy 5.3 nearly.
"""

import json
import os
import sys
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Vector
from mathutils.bvhtree import BVHTree

sys.path.insert(0, str(Path(__file__).parent))  # an installed Blender does not search beside its script
from blender_materials import dress, limit_material

FOREIGN_SIZE_M = 6.0  # a mesh of unknown units is scaled to this largest dimension
SUN_IRRADIANCE = np.pi  # a white Lambert plate facing the Sun has radiance 1
SUN_ANGLE_RAD = 0.00925  # angular diameter of the Sun at 1 au
EARTHSHINE_RADIANCE = 0.06  # uniform light from all directions, relative to that plate's radiance
LARGEST_FLOAT16 = 65504.0
BACKGROUND_DEPTH_M = 1e9  # larger depths are background: Cycles writes 1e10 there
UNDENOISED_SAMPLES = 16  # times as many light paths where there is no denoiser
MARGIN_PX = 8  # rendered around the target's outline: the denoiser looks at a pixel's neighbours


def load(path, shipped, materials):
    """Load a mesh file into an empty scene and return its facts.

    A mesh that is not `shipped` with the project is centred and scaled to 6 m, and its materials are limited.

    Args:
        materials: `own`, those of the file, or `foil`, crinkled foil and cell glass in their place.
    """
    bpy.ops.wm.read_factory_settings(use_empty=True)
    to_file_axes = import_mesh(path)
    meshes = mesh_objects()  # what the importer adds to show bones is not in the view layer
    for o in list(bpy.context.scene.objects):
        if o not in meshes and o.type in ("MESH", "CAMERA", "LIGHT"):
            bpy.data.objects.remove(o)
    if not meshes:
        raise ValueError("the file holds no triangles")
    bpy.context.view_layer.update()
    for o in meshes:  # apply every object's transform to its vertices
        o.data = o.data.copy()
        o.data.transform(to_file_axes @ o.matrix_world)
        o.parent = None
        o.matrix_world = Matrix.Identity(4)
    low, high = bounds(meshes)
    extent = float((high - low).max())
    if not (np.isfinite(extent) and extent > 0):
        raise ValueError("the mesh has no extent: is its compression supported?")
    if not shipped:
        middle = (low + high) / 2
        fit = Matrix.Scale(FOREIGN_SIZE_M / extent, 4) @ Matrix.Translation(Vector(-middle))
        for o in meshes:
            o.data.transform(fit)
        extent = FOREIGN_SIZE_M
    recomputed = sum(recompute_normals(o) for o in meshes)
    if materials == "foil":
        dress(meshes)
    elif not shipped:
        for material in bpy.data.materials:
            limit_material(material)
    bpy.context.view_layer.update()
    CORNERS["body"] = all_corners()
    triangles = sum(len(p.vertices) - 2 for o in meshes for p in o.data.polygons)
    return {"largest_dimension_m": extent, "triangles": triangles, "normals_recomputed": recomputed}


def import_mesh(path):
    """Import a file's objects and return the rotation from Blender's axes to the file's.

    Blender turns the y-up of glTF into its own z-up; the body frame keeps the file's axes.
    """
    suffix = Path(path).suffix.lower()
    if suffix in (".glb", ".gltf"):
        bpy.ops.import_scene.gltf(filepath=path)
        to_file_axes = Matrix.Rotation(-np.pi / 2, 4, "X")
    elif suffix == ".obj":
        bpy.ops.wm.obj_import(filepath=path, forward_axis="Y", up_axis="Z")
        to_file_axes = Matrix.Identity(4)
    elif suffix == ".stl":
        bpy.ops.wm.stl_import(filepath=path)
        to_file_axes = Matrix.Identity(4)
    else:
        raise ValueError(f"expected a .glb, .gltf, .obj or .stl file, got {suffix or 'no suffix'}")
    return to_file_axes


def mesh_objects():
    """Return the objects of the view layer that have faces."""
    return [o for o in bpy.context.view_layer.objects if o.type == "MESH" and len(o.data.polygons)]


def bounds(meshes):
    """Return the smallest and the largest coordinates [3] of all vertices."""
    points = np.concatenate([vertices(o) for o in meshes])
    return points.min(0), points.max(0)


def vertices(o):
    """Return an object's vertices [V, 3]."""
    flat = np.empty(3 * len(o.data.vertices), dtype=np.float64)
    o.data.vertices.foreach_get("co", flat)
    return flat.reshape(-1, 3)


CORNERS = {}


def all_corners():
    """Return the vertices [V, 3] of everything that is rendered, bones and instances applied."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    placed = []
    for instance in depsgraph.object_instances:
        if instance.object.type == "MESH" and len(instance.object.data.vertices):
            to_body = np.array(instance.matrix_world)
            placed.append(vertices(instance.object) @ to_body[:3, :3].T + to_body[:3, 3])
    return np.concatenate(placed)


def recompute_normals(o):
    """Replace stored normals by smooth shading with edges sharper than 30 degrees; return whether there were any.

    Stored normals are not reliable: NASA's SOHO has normals and faces that point inwards, and it renders black.
    Without stored normals Cycles shades both sides of a face alike.
    """
    mesh = o.data
    attribute = mesh.attributes.get("custom_normal")
    if attribute is not None:
        mesh.attributes.remove(attribute)
    elif mesh.has_custom_normals:  # before Blender 4.5 they are no attribute
        with bpy.context.temp_override(object=o, active_object=o, mesh=mesh):
            bpy.ops.mesh.customdata_custom_splitnormals_clear()
    else:
        return False
    mesh.set_sharp_from_angle(angle=np.pi / 6)
    return True


def set_up(samples, ambient):
    """Set up Cycles, the Sun, Earthshine and the camera of the scene; return whether there is a denoiser."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    # not 1: then a thread of TBB (2021) spins from the first picture on, also while nothing is asked for
    scene.render.threads_mode, scene.render.threads = "FIXED", 2
    scene.render.film_transparent = True
    scene.render.use_compositing = scene.render.use_sequencer = False
    scene.render.use_persistent_data = True  # the ray tracing tree of the mesh is built once
    scene.render.use_border = scene.render.use_crop_to_border = True
    cycles = scene.cycles
    cycles.device, cycles.samples, cycles.use_adaptive_sampling = "CPU", samples, False
    cycles.max_bounces = 3
    try:
        cycles.denoiser = "OPENIMAGEDENOISE"
        cycles.use_denoising = samples > 1
        # filtering albedo and normals first takes twice as long and gains nothing
        cycles.denoising_prefilter = "NONE"
        denoises = True
    except TypeError:  # built without it, as Debian's Blender is: then noise is averaged away
        cycles.use_denoising = denoises = False
        cycles.samples = samples * UNDENOISED_SAMPLES if samples > 1 else 1
    cycles.seed = 0
    layer = scene.view_layers[0]
    layer.use_pass_combined = layer.use_pass_z = layer.use_pass_normal = True
    world = bpy.data.worlds.new("earthshine")
    world.use_nodes = True
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (1, 1, 1, 1)
    scene.world, scene["ambient"] = world, ambient
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    sun.data.energy, sun.data.angle = SUN_IRRADIANCE, SUN_ANGLE_RAD
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(sun)
    scene.collection.objects.link(camera)
    scene.camera = camera
    return denoises


def place(request):
    """Place camera and Sun as requested; OpenCV's axes and pixel coordinates become Blender's."""
    scene = bpy.context.scene
    world_to_camera, K = np.array(request["world_to_camera"]), np.array(request["K"])
    width, height = request["width"], request["height"]
    scene.render.resolution_x, scene.render.resolution_y = width, height
    scene.render.resolution_percentage = 100
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = (1.0, fx / fy) if fx >= fy else (fy / fx, 1.0)
    R, t = world_to_camera[:3, :3], world_to_camera[:3, 3]
    pose = np.eye(4)
    pose[:3, :3] = R.T @ np.diag([1.0, -1.0, -1.0])
    pose[:3, 3] = -R.T @ t
    camera = scene.camera
    camera.matrix_world = Matrix(pose.tolist())
    data = camera.data
    data.sensor_fit, data.sensor_width = "HORIZONTAL", 36.0
    data.lens = 36.0 * fx / width
    data.shift_x = (width / 2 - cx) / width
    data.shift_y = (cy - height / 2) / width * (fx / fy)
    range_m = float(np.linalg.norm(t))
    data.clip_start, data.clip_end = max(range_m / 1000, 0.01), range_m * 10 + 1000
    sun = scene.objects["sun"]
    direction = Vector(request["sun_dir_body"])
    sun.rotation_mode = "QUATERNION"
    sun.rotation_quaternion = direction.to_track_quat("Z", "Y")
    in_eclipse = request.get("in_eclipse", False)  # then the Earth below is dark, too: no Earthshine
    sun.data.energy = 0.0 if in_eclipse else SUN_IRRADIANCE
    world = scene.world.node_tree.nodes["Background"].inputs["Strength"]
    world.default_value = 0.0 if in_eclipse else scene["ambient"]


PASSES = {}


def keep_passes():
    """Let Cycles leave its render passes in PASSES: float32, without a file and without a view transform."""
    from cycles import CyclesRender

    original = CyclesRender.render

    def render(self, depsgraph):
        original(self, depsgraph)
        result = self.get_result()
        for p in result.layers[0].passes:
            flat = np.empty(result.resolution_x * result.resolution_y * p.channels, dtype=np.float32)
            p.rect.foreach_get(flat)
            image = flat.reshape(result.resolution_y, result.resolution_x, p.channels)
            PASSES[p.name] = image[::-1]  # Blender's rows start at the bottom

    CyclesRender.render = render


def window(request):
    """Return the part of the picture that the target can touch, and a margin: left, top, right, bottom, px.

    It is the whole picture where some of the target is not in front of the camera.
    """
    size = np.array([request["width"], request["height"]])
    world_to_camera = np.array(request["world_to_camera"])
    rays = (CORNERS["body"] @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]) @ np.array(request["K"]).T
    if rays[:, 2].min() <= 0:
        return 0, 0, *size.tolist()
    places = rays[:, :2] / rays[:, 2:]
    low = np.clip(np.floor(places.min(0)) - MARGIN_PX, 0, size)
    high = np.clip(np.ceil(places.max(0)) + MARGIN_PX, 0, size)
    return *low.astype(int).tolist(), *high.astype(int).tolist()


def pictures(request, **background):
    """Render the window of a request; return the named passes [H, W, channels] of the whole picture, float32.

    What lies outside the window has the values `background` [channels] of the pass. The rays of a pixel, and so its
    noise before the denoiser, do not depend on the window.
    """
    left, top, right, bottom = window(request)
    width, height = request["width"], request["height"]
    whole = [np.full((height, width, len(v)), v, dtype=np.float32) for v in background.values()]
    if left < right and top < bottom:  # the target is in view
        place(request)
        r = bpy.context.scene.render  # whole pixels: Blender rounds down; its rows start at the bottom
        r.border_min_x, r.border_max_x = (left + 0.25) / width, min(1, (right + 0.25) / width)
        r.border_min_y = (height - bottom + 0.25) / height
        r.border_max_y = min(1, (height - top + 0.25) / height)
        PASSES.clear()
        bpy.ops.render.render(write_still=False)
        for image, name in zip(whole, background, strict=True):
            image[top:bottom, left:right] = PASSES[name]
    return whole


def render(request):
    """Write one view: radiance, premultiplied by coverage, in float16 (float32 if requested), and coverage (alpha).

    The light paths are those of the seed that is requested, default 0.
    """
    bpy.context.scene.cycles.seed = request.get("seed", 0)
    (combined,) = pictures(request, Combined=(0, 0, 0, 0))
    alpha = np.clip(combined[..., 3], 0, 1)
    radiance = np.clip(np.nan_to_num(combined[..., :3]), 0, LARGEST_FLOAT16)
    radiance[alpha == 0] = 0  # the denoiser spreads light beyond the target's outline
    if request["channels"] == 1:
        radiance = radiance @ np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)  # Rec. 709 luminance
        radiance = radiance[..., None]
    dtype = np.float32 if request.get("float32") else np.float16
    coverage = np.round(alpha * 255).astype(np.uint8)
    write_whole(request["out"], radiance=radiance.astype(dtype), alpha=coverage)


def geometry(request):
    """Write planar depth, m (inf: background), and unit normal, body axes, at each pixel's centre."""
    cycles = bpy.context.scene.cycles
    usual = {
        "samples": cycles.samples,
        "use_denoising": cycles.use_denoising,
        "max_bounces": cycles.max_bounces,
    }
    usual |= {"pixel_filter_type": cycles.pixel_filter_type, "filter_width": cycles.filter_width}
    one_ray = {"samples": 1, "use_denoising": False, "max_bounces": 0}
    one_ray |= {"pixel_filter_type": "BOX", "filter_width": 0.01}  # px; no smaller one is possible
    try:
        for name, value in one_ray.items():
            setattr(cycles, name, value)
        depth, normals = pictures(request, Depth=(np.inf,), Normal=(0, 0, 0))
    finally:
        for name, value in usual.items():
            setattr(cycles, name, value)
    depth[depth > BACKGROUND_DEPTH_M] = np.inf
    write_whole(request["out"], depth=depth[..., 0], normals=normals.astype(np.float16))


def write_whole(out, **arrays):
    """Write an .npz file under a temporary name and rename it, so that it is complete or missing."""
    part = out + f".{os.getpid()}.part"
    with open(part, "wb") as f:
        np.savez_compressed(f, **arrays)
    os.replace(part, out)


def surface():
    """Return the scene's triangles as vertices [V, 3] m and faces [F, 3]."""
    all_vertices, all_faces, offset = [], [], 0
    for o in mesh_objects():
        o.data.calc_loop_triangles()
        faces = np.empty(3 * len(o.data.loop_triangles), dtype=np.int32)
        o.data.loop_triangles.foreach_get("vertices", faces)
        all_vertices.append(vertices(o))
        all_faces.append(faces.reshape(-1, 3) + offset)
        offset += len(o.data.vertices)
    return np.concatenate(all_vertices), np.concatenate(all_faces)


def visible(request):
    """Write which points at least one camera centre sees, by casting a ray from the point towards each camera."""
    v, f = surface()
    tree = BVHTree.FromPolygons(v.tolist(), f.tolist())
    with np.load(request["points"]) as given:
        points, centres = given["points"], given["centres"]
    lift_m = 1e-4 * float(np.ptp(v, axis=0).max())
    seen = np.zeros(len(points), dtype=bool)
    for centre in centres:
        hidden = np.flatnonzero(~seen)
        directions = centre - points[hidden]
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        rays = zip((points[hidden] + lift_m * directions).tolist(), directions.tolist(), strict=True)
        seen[hidden] = [tree.ray_cast(origin, direction)[0] is None for origin, direction in rays]
    write_whole(request["out"], seen=seen)


def answer(request):
    """Carry out a request and return the facts for its reply."""
    op = request["op"]
    if op == "load":
        facts = load(request["mesh"], request["shipped"], request["materials"])
        denoises = set_up(request["samples"], request.get("ambient", EARTHSHINE_RADIANCE))
        return {**facts, "denoises": denoises}
    if op == "render":
        render(request)
        return {}
    if op == "geometry":
        geometry(request)
        return {}
    if op == "surface":
        v, f = surface()
        with open(request["out"], "wb") as out:
            np.savez(out, vertices=v, faces=f)
        return {}
    if op == "visible":
        visible(request)
        return {}
    raise ValueError(f"unknown operation {op!r}")


def in_words(error):
    """Return what went wrong as one line, as Blender says it or we do."""
    said = " ".join(str(error).split()).removeprefix("Error: ")
    return f"{type(error).__name__} {said}".strip() if isinstance(error, KeyError) or not said else said


def main():
    replies = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what Blender itself prints goes to stderr, so that stdout holds replies only
    keep_passes()
    print(json.dumps({"ready": bpy.app.version_string}), file=replies, flush=True)
    for line in sys.stdin:
        try:
            reply = {"ok": True, **answer(json.loads(line))}
        except (RuntimeError, ValueError, KeyError, OSError) as error:
            reply = {"ok": False, "error": in_words(error)}
        print(json.dumps(reply), file=replies, flush=True)


if __name__ == "__main__":
    main()
