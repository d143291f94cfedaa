"""The materials of a mesh in Blender, in whose own Python this runs: limited as they are, or made foil and glass.

Crinkled foil and cell glass are what satellites are covered with. Both reflect by the microfacet distribution GGX
(Walter et al. 2007), Blender's own.
"""

import bpy
from crinkles import TILE_M, heights_m

MAX_METALLIC = 0.3  # a metal reflects its surroundings, which are black here except for the Sun
MIN_ROUGHNESS = 0.15  # a smoother surface shows nothing but a point-like reflection of the Sun
DARK = 0.1  # luminance of a base colour below which a surface becomes cell glass, otherwise foil
GOLD, GOLD_ROUGHNESS = (
    (0.83, 0.54, 0.16, 1.0),
    0.3,
)  # linear; the roughness of what is too small for the crinkles
GLASS, GLASS_ROUGHNESS = (
    (0.012, 0.015, 0.03, 1.0),
    0.15,
)  # black-blue cells behind a plain dielectric of index 1.5


def limit_material(material):
    """Keep a material visible under one Sun: limit how metallic and how smooth it is, and remove emission."""
    if not material.use_nodes:
        return
    nodes = list(material.node_tree.nodes)
    shaders = [node for node in nodes if node.type == "BSDF_PRINCIPLED"]
    if not shaders:
        for node in nodes:
            if node.type == "EMISSION":
                replace_emission(material, node)
    links = material.node_tree.links
    for shader in shaders:
        limit_input(material, shader.inputs["Metallic"], "MINIMUM", MAX_METALLIC)
        limit_input(material, shader.inputs["Roughness"], "MAXIMUM", MIN_ROUGHNESS)
        emission = [shader.inputs["Emission Strength"], shader.inputs["Emission Color"]]
        for link in [link for socket in emission for link in socket.links]:
            links.remove(link)
        shader.inputs["Emission Strength"].default_value = 0.0


def limit_input(material, socket, operation, bound):
    """Replace a shader's input, a value or a texture, by its minimum or maximum with a bound."""
    links = material.node_tree.links
    for link in list(socket.links):
        clamp = material.node_tree.nodes.new("ShaderNodeMath")
        clamp.operation = operation
        clamp.inputs[1].default_value = bound
        source = link.from_socket
        links.remove(link)
        links.new(source, clamp.inputs[0])
        links.new(clamp.outputs[0], socket)
    limit = min if operation == "MINIMUM" else max
    socket.default_value = limit(socket.default_value, bound)


def replace_emission(material, emission):
    """Make an unlit material (KHR_materials_unlit, imported as emission) a matt one of the same colour."""
    links = material.node_tree.links
    matt = material.node_tree.nodes.new("ShaderNodeBsdfDiffuse")
    matt.inputs["Color"].default_value = emission.inputs["Color"].default_value
    for link in list(emission.inputs["Color"].links):
        links.new(link.from_socket, matt.inputs["Color"])
    for node in material.node_tree.nodes:
        if node.type == "OUTPUT_MATERIAL":
            links.new(matt.outputs["BSDF"], node.inputs["Surface"])


def dress(meshes):
    """Replace all materials: dark surface becomes cell glass and the rest crinkled gold foil, by the base colour."""
    heights = height_image()
    for material in bpy.data.materials:
        dress_material(material, heights)
    bare = [o for o in meshes if not any(o.data.materials)]
    if bare:
        foil = bpy.data.materials.new("foil")
        dress_material(foil, heights)
    for o in bare:
        o.data.materials.clear()
        o.data.materials.append(foil)


def height_image():
    """Return the crinkles' heights as a picture, of which 0 is no height and 1 is one metre."""
    heights = heights_m()
    image = bpy.data.images.new(
        "crinkles", heights.shape[1], heights.shape[0], float_buffer=True, is_data=True
    )
    pixels = [[h, h, h, 1.0] for h in heights.ravel().tolist()]
    image.pixels = [value for pixel in pixels for value in pixel]
    return image


def dress_material(material, heights):
    """Make a material foil, or glass where its base colour, a value or a texture, is dark."""
    material.use_nodes = True
    tree = material.node_tree
    colour, source = base_colour(tree)
    mix = tree.nodes.new("ShaderNodeMixShader")
    dark = tree.nodes.new("ShaderNodeMath")
    dark.operation, dark.inputs[1].default_value = "LESS_THAN", DARK
    luminance = tree.nodes.new("ShaderNodeRGBToBW")
    luminance.inputs["Color"].default_value = colour
    if source is not None:
        tree.links.new(source, luminance.inputs["Color"])
    tree.links.new(luminance.outputs["Val"], dark.inputs[0])
    tree.links.new(dark.outputs["Value"], mix.inputs["Fac"])
    tree.links.new(foil(tree, heights).outputs["BSDF"], mix.inputs[1])
    glass = principled(tree, GLASS, 0.0, GLASS_ROUGHNESS)
    tree.links.new(glass.outputs["BSDF"], mix.inputs[2])
    output = next((n for n in tree.nodes if n.type == "OUTPUT_MATERIAL"), None)
    output = output or tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(mix.outputs["Shader"], output.inputs["Surface"])


def base_colour(tree):
    """Return a material's base colour [4] and the socket that it comes from, None where it is a value."""
    for name in ("Base Color", "Color"):
        for node in tree.nodes:
            socket = node.inputs.get(name)
            if socket is not None and (node.type.startswith("BSDF") or node.type == "EMISSION"):
                return tuple(socket.default_value), socket.links[0].from_socket if socket.links else None
    return (1.0, 1.0, 1.0, 1.0), None


def foil(tree, heights):
    """Return a shader of gold foil whose normal follows the crinkles, which lie along the body's axes."""
    shader = principled(tree, GOLD, 1.0, GOLD_ROUGHNESS)
    place = tree.nodes.new("ShaderNodeTexCoord")
    scaled = tree.nodes.new("ShaderNodeMapping")
    scaled.inputs["Scale"].default_value = (1 / TILE_M,) * 3
    picture = tree.nodes.new("ShaderNodeTexImage")
    picture.image, picture.projection, picture.projection_blend = heights, "BOX", 0.1
    bump = tree.nodes.new("ShaderNodeBump")
    bump.inputs["Distance"].default_value = 1.0  # m for a height of 1
    tree.links.new(place.outputs["Object"], scaled.inputs["Vector"])
    tree.links.new(scaled.outputs["Vector"], picture.inputs["Vector"])
    tree.links.new(picture.outputs["Color"], bump.inputs["Height"])
    tree.links.new(bump.outputs["Normal"], shader.inputs["Normal"])
    return shader


def principled(tree, colour, metallic, roughness):
    """Return a new Principled shader, which is GGX."""
    shader = tree.nodes.new("ShaderNodeBsdfPrincipled")
    shader.inputs["Base Color"].default_value = colour
    shader.inputs["Metallic"].default_value = metallic
    shader.inputs["Roughness"].default_value = roughness
    return shader
