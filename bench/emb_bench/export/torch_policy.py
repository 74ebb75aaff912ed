"""Policy files of networks of torch: a module, a function of a tensor, a model of Stable-Baselines3."""

from __future__ import annotations

import copy
import io
import logging
import math
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from emb_bench.config.bench import Bench
from emb_bench.export.own_policy import PORT, WIDTHS, bare, first_line, own_policy
from emb_bench.export.policy_file import OPSET, printable, versions
from emb_bench.information.symmetric import Floats
from emb_runtime.errors import PolicyRefusedError, UsageError
from emb_runtime.policy.contract import greatest_output
from emb_runtime.policy.policy import INPUT_NAME, OUTPUT_NAME

SPACE = "expected the spaces of EmbExcitation-v0: Box observations of 3 or 11 numbers, one action from -1 to 1"


def module_policy(policy: Any, bench: Bench, kind: str) -> tuple[bytes, str]:
    """The policy file of a torch module, a function of a tensor, or a model of Stable-Baselines3; and its origin.

    Args:
        policy: a module or a function that gives outputs, shape [N, 1], for inputs, shape [N, 3] or [N, 11]; or a
            model that was trained on ``EmbExcitation-v0``, with the normalisation of its environment.
        bench: limits, sample time and horizon that it is for.
        kind: of the output, one of :data:`emb_runtime.policy.contract.UNITS`; an action of 1 is the bench's limit.

    Raises:
        UsageError: the model has other spaces than the environment.
        PolicyRefusedError: torch cannot export it, or see :func:`emb_bench.export.own_policy.onnx_policy`.
    """
    name = type(policy).__name__
    if hasattr(policy, "policy") and hasattr(policy, "observation_space"):
        module, widths = _deployed(policy, bench, kind)
    elif isinstance(policy, torch.nn.Module):
        module, widths = _copied(policy), tuple(WIDTHS)
    else:
        module, widths = _Called(policy), tuple(WIDTHS)
    validates = torch.distributions.Distribution._validate_args
    torch.distributions.Distribution.set_default_validate_args(False)  # its checks cannot be exported
    try:
        width = _width(module, widths, kind)
        graph = torch_graph(module, width)

        def source(seen: NDArray[np.float32]) -> Floats:
            with torch.no_grad():
                return np.array([module(torch.from_numpy(row[None])).numpy() for row in seen], np.float64)

        provenance = {"module": printable(name), **versions("torch")}
        return own_policy(graph, bench, provenance, f"the {name}", source, kind)
    finally:
        torch.distributions.Distribution.set_default_validate_args(validates)


def torch_graph(module: nn.Module, width: int) -> onnx.ModelProto:
    """The graph of a torch module for one row of numbers, without traces of this machine."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)  # its chatter is nothing that a user can act on
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the exporter's, about itself
            program = torch.onnx.export(
                module,
                (torch.zeros(1, width),),
                dynamo=True,
                opset_version=OPSET,
                input_names=[INPUT_NAME],
                output_names=[OUTPUT_NAME],
                verbose=False,
            )
    except Exception as err:  # torch.export raises whatever the module's operations meet
        raise PolicyRefusedError(f"torch cannot export it: {first_line(err)}: use operations of torch alone") from err
    finally:
        logger.setLevel(level)
    assert program is not None  # it is None only for the old exporter
    return bare(program.model_proto)


def _copied(module: nn.Module) -> nn.Module:
    """The module in evaluation, in single precision, on the processor; the original stays as it is."""
    try:
        return copy.deepcopy(module).cpu().float().eval()
    except Exception as err:  # whatever its parts raise
        raise PolicyRefusedError(f"the module cannot be copied: {first_line(err)}") from err


class _Called(nn.Module):
    """A function as a module."""

    def __init__(self, function: Callable[[Tensor], Tensor]) -> None:
        super().__init__()
        self._function = function

    def forward(self, inputs: Tensor) -> Tensor:
        """Its outputs."""
        return self._function(inputs)


class _Deployed(nn.Module):
    """A policy of Stable-Baselines3 with the inputs and the output of the contract."""

    mean: Tensor
    deviation: Tensor

    def __init__(self, policy: Any, scales: Any, size: int, limit: float, sample_time: float) -> None:
        super().__init__()
        self._policy, self._limit, self._sample_time, self._reach = policy, limit, sample_time, math.inf
        mean, deviation = np.zeros(size), np.ones(size)
        if scales is not None and scales.norm_obs:
            mean, deviation = scales.obs_rms.mean, np.sqrt(scales.obs_rms.var + scales.epsilon)
            self._reach = float(scales.clip_obs)
        self.register_buffer("mean", torch.tensor(mean, dtype=torch.float32))
        self.register_buffer("deviation", torch.tensor(deviation, dtype=torch.float32))

    def forward(self, inputs: Tensor) -> Tensor:
        """Its outputs, shape [N, 1]; it was trained on the number of the step in place of the time."""
        seen = torch.cat([inputs[:, :2], inputs[:, 2:3] / self._sample_time, inputs[:, 3:]], 1)
        scaled = torch.clamp((seen - self.mean) / self.deviation, -self._reach, self._reach)
        action: Tensor = self._policy._predict(scaled, deterministic=True)
        return self._limit * torch.clamp(action, -1.0, 1.0)


def _deployed(model: Any, bench: Bench, kind: str) -> tuple[nn.Module, tuple[int, ...]]:
    """A model of Stable-Baselines3 as a module with our inputs, and how many those are."""
    seen, acts = getattr(model.observation_space, "shape", None), model.action_space
    bounded = getattr(acts, "shape", None) == (1,) and hasattr(acts, "low") and (acts.low, acts.high) == (-1.0, 1.0)
    if not bounded or seen not in [(width,) for width in WIDTHS]:
        raise UsageError(f"{SPACE}; got {printable(str(model.observation_space))}, {printable(str(acts))}")
    if model.get_env() is None:
        raise UsageError(
            "expected the model with its environment, which may scale observations: PPO.load(FILE, env=env)"
        )
    copy = io.BytesIO()  # as its library copies a policy: copy.deepcopy cannot
    model.policy.save(copy)
    copy.seek(0)
    policy = type(model.policy).load(copy, device="cpu").eval()
    limit, sample_time = greatest_output(kind, bench.limits), bench.timing.sample_time
    return _Deployed(policy, model.get_vec_normalize_env(), seen[0], limit, sample_time).eval(), seen


def _width(module: nn.Module, widths: tuple[int, ...], kind: str) -> int:
    """Number of inputs that a module takes."""
    reason = ""
    for width in widths:
        try:
            with torch.no_grad():
                answer = module(torch.zeros(1, width))
        except Exception as err:  # whatever its operations raise
            reason = reason or first_line(err)
            continue
        if not isinstance(answer, Tensor):
            raise PolicyRefusedError(f"expected a function of torch, which gives a tensor, got {type(answer).__name__}")
        if answer.numel() == 1:
            return width
        reason = reason or f"its output has the shape {list(answer.shape)}"  # a slice of too few numbers is empty
    raise PolicyRefusedError(
        f"it gives no {kind} of a row of {' or '.join(map(str, widths))} numbers: {reason}: {PORT}"
    )
