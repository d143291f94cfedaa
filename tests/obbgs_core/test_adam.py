"""The optimiser's step against torch.optim.Adam, and the compiled step against the readable one."""

import pytest
import torch

from obbgs_core import compiled
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.train.adam import Adam

needs_native = pytest.mark.skipif(compiled._rasterizer is None, reason="the compiled module is not installed")
COEFFICIENT_RATES = torch.tensor([1.0] + [0.05] * 15).reshape(1, 16, 1) * 0.01  # as 3DGS sets them
RATES = {"means": 1e-3, "quats": 2e-3, "log_scales": 5e-3, "opacity_logits": 0.05, "sh": 0.01}


def gaussians(count: int = 3000, dtype=torch.float32) -> Gaussians:
    g = torch.Generator().manual_seed(4)
    shapes = ((3,), (4,), (3,), (), (16, 3))
    return Gaussians(*(torch.randn(count, *s, generator=g).to(dtype) for s in shapes)).trainable()


def with_gradients(model: Gaussians, step: int) -> Gaussians:
    """Give every parameter a gradient of its own: a tenth of them zero, the others 1e-6 to 1e6 of either sign."""
    g = torch.Generator().manual_seed(100 + step)
    for tensor in model.tensors().values():
        size = 10 ** (12 * torch.rand(tensor.shape, generator=g) - 6)
        sign = torch.randint(-4, 6, tensor.shape, generator=g).clamp(-1, 1)
        tensor.grad = (size * sign).to(tensor.dtype)
    return model


def after(
    steps: int, model: Gaussians, rates: dict = RATES, memory: float = 0.999
) -> dict[str, torch.Tensor]:
    adam = Adam(model, (0.9, memory))
    for step in range(steps):
        adam.step(with_gradients(model, step), rates)
    return {name: tensor.detach() for name, tensor in model.tensors().items()}


@pytest.mark.parametrize("memory", [0.999, 0.99])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_twenty_steps_end_where_torch_optim_ends(dtype, memory):
    ours, theirs = after(20, gaussians(dtype=dtype), memory=memory), gaussians(dtype=dtype)
    groups = [{"params": [t], "lr": RATES[n]} for n, t in theirs.tensors().items()]
    optimiser = torch.optim.Adam(groups, betas=(0.9, memory), eps=1e-15)
    for step in range(20):
        with_gradients(theirs, step)
        optimiser.step()
    for name, expected in theirs.tensors().items():
        # ours adds eps before the bias correction: 3e-8 of a step at gradients of 1e-6; float32 rounds values up to 4
        atol = 1e-8 if dtype == torch.float64 else 1e-5
        torch.testing.assert_close(ours[name], expected.detach(), rtol=0, atol=atol, msg=name)


@needs_native
@pytest.mark.parametrize("sh", [0.01, COEFFICIENT_RATES], ids=["one rate", "a rate a coefficient"])
def test_the_compiled_step_is_the_readable_step(monkeypatch, sh):
    rates = RATES | {"sh": sh}
    native = after(20, gaussians(), rates)
    monkeypatch.setattr(compiled, "_rasterizer", None)
    for name, expected in after(20, gaussians(), rates).items():
        torch.testing.assert_close(native[name], expected, rtol=0, atol=2e-6, msg=name)


@needs_native
def test_the_step_does_not_depend_on_the_number_of_threads(use_threads):
    results = []
    for threads in (1, 2, 5):
        use_threads(threads)
        results.append(after(3, gaussians()))
    for other in results[1:]:
        assert all(torch.equal(other[name], value) for name, value in results[0].items())


def test_a_parameter_without_a_gradient_stays_and_gradients_are_dropped():
    model = with_gradients(gaussians(10), 0)
    model.means.grad, before = None, {n: t.detach().clone() for n, t in model.tensors().items()}
    Adam(model).step(model, RATES)
    assert torch.equal(model.means, before["means"]) and not torch.equal(model.sh, before["sh"])
    assert all(t.grad is None for t in model.tensors().values())
