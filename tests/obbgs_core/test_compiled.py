"""Which kernels run: the best by default, another by name, all with the same result; and what the module holds."""

import ast
import itertools
import math
import re
import threading
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from obbgs_core import compiled
from obbgs_core.losses import fit_figures, likelihood_loss, published_loss
from obbgs_core.model import sh
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import native_kernels, projection, reference
from obbgs_core.sensor import Sensor
from obbgs_core.train.adam import Adam

pytestmark = pytest.mark.skipif(not compiled.kernels(), reason="the compiled module is not installed")
SENSOR = Sensor(black_dn=64, white_dn=4095, dn_per_radiance_s=4e7, electrons_per_dn=2.0, read_noise_dn=3.0)


@pytest.fixture
def choose(monkeypatch):
    """Choose a kernel as the environment would in a new process; the process gets its own back afterwards."""

    def chosen(name: str) -> tuple[str, ...]:
        monkeypatch.setenv("OBBGS_KERNEL", name)
        compiled.kernels.cache_clear()
        native_kernels.cache_clear()
        return native_kernels()

    yield chosen
    monkeypatch.undo()
    compiled.kernels.cache_clear()
    native_kernels.cache_clear()
    compiled.kernels()


def test_the_environment_names_the_kernel_and_no_name_is_the_best(choose):
    best_first = choose("")
    assert best_first[-1] == "portable"
    for kernel in best_first:
        first, *others = choose(kernel)
        assert first == kernel and others == [name for name in best_first if name != kernel]


def test_a_kernel_that_this_processor_does_not_run_is_refused_with_those_that_it_runs(choose):
    known = ", ".join(choose(""))
    with pytest.raises(ValueError, match=f"OBBGS_KERNEL must be one of {known} .*, got 'sse9'"):
        choose("sse9")
    assert compiled._rasterizer is not None
    with pytest.raises(ValueError, match=f"this processor runs the kernels {known}, not 'sse9'"):
        compiled._rasterizer.use_kernel("sse9")


def losses_and_a_step() -> list[torch.Tensor]:
    """Return what the losses and Adam make of one set of images and parameters, values and gradients."""
    g = torch.Generator().manual_seed(5)
    dn = (64 + 4500 * torch.rand(2, 53, 37, 3, generator=g)).round().clamp(max=4095)
    exposures_s = torch.tensor([1e-4, 2e-4]).reshape(2, 1, 1, 1)
    radiance = (
        (dn - 64) / 4e7 / exposures_s * (0.8 + 0.4 * torch.rand(dn.shape, generator=g))
    ).requires_grad_()
    results = []
    for loss in (likelihood_loss, published_loss):
        value, residual = loss(radiance, exposures_s, dn, SENSOR, edge_weight=0.2)
        results += [value.detach(), residual, *torch.autograd.grad(value, radiance)]
    alpha = torch.rand(dn.shape[:3], generator=g)
    results.append(torch.tensor(fit_figures(radiance, alpha, exposures_s, dn, SENSOR)))
    shapes = ((3,), (4,), (3,), (), (4, 1))
    model = Gaussians(*(torch.randn(1001, *shape, generator=g) for shape in shapes)).trainable()
    adam = Adam(model)
    for _ in range(3):
        for tensor in model.tensors().values():
            tensor.grad = torch.randn(tensor.shape, generator=g)
        adam.step(model, dict.fromkeys(model.tensors(), 0.01))
    return results + [tensor.detach() for tensor in model.tensors().values()]


def test_losses_and_adam_are_the_same_with_every_kernel(choose):
    """To the bit, on one processor: no loop adds up across lanes, and none contracts a*b + c."""
    choose("portable")
    truth = losses_and_a_step()
    assert all(value.isfinite().all() for value in truth)
    for kernel in choose(""):
        choose(kernel)
        assert all(torch.equal(a, b) for a, b in zip(losses_and_a_step(), truth, strict=True)), kernel


def test_python_and_the_kernels_share_their_constants():
    module = compiled.module_for()
    assert module is not None
    python = {
        "MIN_ALPHA": reference.MIN_ALPHA,
        "LOG2_MIN_ALPHA": math.log2(reference.MIN_ALPHA),
        "MAX_ALPHA": reference.MAX_ALPHA,
        "MIN_TRANSMITTANCE": reference.MIN_TRANSMITTANCE,
        "MIN_PEAK_SHARE": projection.MIN_PEAK_SHARE,
        "MIN_DEPTH_ALPHA": reference.MIN_DEPTH_ALPHA,
        "FOV_MARGIN": projection.FOV_MARGIN,
        "SOFTNESS": sh.SOFTNESS,
    }
    for name, value in python.items():
        assert getattr(module, name) == np.float32(value), name


def test_the_stub_names_everything_in_the_module_and_nothing_else():
    def names(tree: ast.Module | ast.ClassDef) -> set[str]:
        found = {node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
        targets = (node.target for node in tree.body if isinstance(node, ast.AnnAssign))
        return found | {target.id for target in targets if isinstance(target, ast.Name)} - {"Array"}

    def public(thing: object) -> set[str]:
        return {name for name in dir(thing) if not name.startswith("_")}

    stub = ast.parse((Path(compiled.__file__).parent / "_rasterizer.pyi").read_text())
    module = compiled.module_for()
    assert names(stub) == public(module)
    for node in stub.body:
        if isinstance(node, ast.ClassDef):
            assert names(node) - {"__init__"} == public(getattr(module, node.name)), node.name
        elif isinstance(node, ast.FunctionDef):  # nanobind writes the arguments' names into the docstring
            signature = getattr(module, node.name).__doc__.partition("->")[0]
            assert [a.arg for a in node.args.args] == re.findall(r"(\w+):", signature), node.name


def test_in_a_block_only_the_compiled_module_keeps_the_threads(use_threads):
    use_threads(3)
    with pytest.raises(RuntimeError), compiled.torch_on_one_thread():
        assert (torch.get_num_threads(), compiled.threads()) == (1, 3)
        with compiled.torch_on_one_thread():
            assert (torch.get_num_threads(), compiled.threads()) == (1, 3)
        assert (torch.get_num_threads(), compiled.threads()) == (1, 3)
        raise RuntimeError
    assert (torch.get_num_threads(), compiled.threads()) == (3, 3)


def test_work_beside_the_caller_runs_on_one_thread_of_pytorch_and_at_once_where_there_is_but_one(use_threads):
    beside = compiled.Background("beside")
    use_threads(1)
    assert beside.submit(threading.get_ident).result() == threading.get_ident()
    use_threads(3)
    assert beside.submit(threading.get_ident).result() != threading.get_ident()
    use_threads(4)  # before the thread's first operation
    assert beside.submit(torch.get_num_threads).result() == 1
    beside.close()


def test_each_item_is_worked_on_by_one_thread_and_results_come_in_order(use_threads):
    use_threads(3)
    met = threading.Barrier(3, timeout=30)  # three are under way at once, or this breaks

    def worked(item: int) -> tuple:
        met.wait()
        grown = torch.zeros(1, requires_grad=True) + item
        return item, threading.get_ident(), compiled.threads(), torch.get_num_threads(), grown.requires_grad

    with torch.no_grad():
        items, idents, *threads, graph = zip(*compiled.each(worked, range(6)), strict=True)
    assert items == tuple(range(6)) and threading.get_ident() not in idents
    assert threads == [(1,) * 6] * 2 and not any(graph)
    assert compiled.threads() == 3
    assert all(graph for *_, graph in compiled.each(worked, range(3)))


@given(st.integers(1, 4), st.integers(0, 12), st.integers(0, 11))
def test_items_are_drawn_as_results_are_taken_and_an_error_comes_in_its_place(count, items, wrong):
    drawn, before = [], torch.get_num_threads()

    def work(item: int) -> int:
        if item == wrong:
            raise KeyError(item)
        return item**2

    torch.set_num_threads(count)
    try:
        found = compiled.each(work, (drawn.append(i) or i for i in range(items)))
        for taken, value in enumerate(itertools.islice(found, wrong)):
            assert value == taken**2 and len(drawn) <= taken + 1 + count
        if wrong < items:
            with pytest.raises(KeyError, match=str(wrong)):
                next(found)
    finally:
        torch.set_num_threads(before)
