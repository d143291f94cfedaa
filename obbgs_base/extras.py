"""Which package this code was installed by, and which modules belong to which extra of it, for what a command says."""

from importlib import metadata

PACKAGES = ("obbgs", "obbgs-flight")  # the whole, and the flight software alone

EXTRAS = {
    "ground": {
        *(
            "cv2",
            "fast_simplification",
            "gsply",
            "manifold3d",
            "onnx",
            "onnxruntime",
            "plotly",
            "scipy",
            "skimage",
            "torch",
        ),
        "trimesh",
        "PIL",
        "tifffile",
    },
    "pictures": {"astropy", "rawpy", "OpenEXR"},  # and those of ground
    "spice": {"spiceypy"},  # and those of ground
    "compare": {"dask", "distributed", "matplotlib", "psutil", "pycolmap"},  # and those of ground
    "basilisk": {"Basilisk"},  # and those of hil
    "view": {"viser"},  # and those of ground
}


def installed_package() -> tuple[str, str]:
    """Return name and version of the package that this code was installed by; the whole one where nothing is installed.

    The version of a mere copy of the sources is "0, not installed".
    """
    for name in PACKAGES:
        try:
            return name, metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return PACKAGES[0], "0, not installed"


def install_command(extra: str) -> str:
    """Return the command that installs an extra of this package."""
    return f"pip install '{installed_package()[0]}[{extra}]'"


def how_to_install(error: ModuleNotFoundError, extra: str) -> str | None:
    """Return how to get a missing module that belongs to an extra of this package; None for any other module.

    Args:
        extra: the one to name, ground or hil; modules that only comparisons, the viewer, kernels, Basilisk or
            some kinds of pictures need are in extras of theirs.
    """
    module = (error.name or "").partition(".")[0]
    if not any(module in modules for modules in EXTRAS.values()):
        return None
    own = (name for name, modules in EXTRAS.items() if name != "ground" and module in modules)
    extra = next(own, extra)
    return (
        f"this command needs {module}, which is not installed: {install_command(extra)}, "
        f"or in a clone of the project: pip install '.[{extra}]'"
    )
