"""Imports without the garbage collector."""

import gc
import sys
from types import ModuleType

import pytest

from obbgs_base.imports import MANY, quick_imports


@pytest.mark.parametrize("count", [0, MANY + 1])
def test_only_what_imports_have_made_is_left_out_of_later_collections(monkeypatch, count):
    monkeypatch.setattr(sys, "modules", dict(sys.modules))
    before = gc.get_freeze_count()
    try:
        with pytest.raises(KeyboardInterrupt), quick_imports():
            assert not gc.isenabled()
            sys.modules.update({f"large.{i}": ModuleType("large") for i in range(count)})
            raise KeyboardInterrupt
        assert gc.isenabled()
        assert (gc.get_freeze_count() > before) == (count > MANY)
    finally:
        if gc.get_freeze_count() > before:
            gc.unfreeze()
            gc.collect()
            gc.freeze()
