"""Which modules belong to which extra of the package, so that a command can say what to install for a missing one."""

EXTRAS = {
    "ground": {
        *(
            "cv2",
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
    },
    "compare": {"dask", "distributed", "matplotlib", "psutil", "pycolmap"},  # and those of ground
    "view": {"viser"},  # and those of ground
}


def how_to_install(error: ModuleNotFoundError, extra: str) -> str | None:
    """Return how to get a missing module that belongs to an extra of this package; None for any other module.

    Args:
        extra: the one to name, ground or hil; modules that only comparisons or the viewer need are in extras of theirs.
    """
    module = (error.name or "").partition(".")[0]
    if not any(module in modules for modules in EXTRAS.values()):
        return None
    extra = next((name for name in ("compare", "view") if module in EXTRAS[name]), extra)
    return (
        f"this command needs {module}, which is not installed: pip install 'obbgs[{extra}]', "
        f"or in a clone of the project: pip install '.[{extra}]'"
    )
