"""Loads the compiled rasterizer of an installed wheel without PyTorch and says which instruction sets it has."""

import sys
from importlib.machinery import ExtensionFileLoader
from importlib.metadata import distribution
from importlib.util import module_from_spec, spec_from_file_location

files = distribution("obbgs").files or []
(compiled,) = [
    file for file in files if file.name.startswith("_rasterizer.") and file.suffix in (".so", ".pyd")
]
path = str(compiled.locate())
spec = spec_from_file_location(
    "obbgs_core._rasterizer", path, loader=ExtensionFileLoader("obbgs_core._rasterizer", path)
)
assert spec is not None and spec.loader is not None
module = module_from_spec(spec)
spec.loader.exec_module(module)
print(sys.version.split()[0], compiled, *sorted(n for n in dir(module) if not n.startswith("_")))
