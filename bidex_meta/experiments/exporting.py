"""A run's policy as one ONNX file, checked against torch."""

import json
import logging
import warnings
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch

from bidex_meta.config import RunConfig
from bidex_meta.errors import BidexError, one_line
from bidex_meta.experiments.learners import learner_kind
from bidex_meta.experiments.policies import load_checkpoint, policy_of
from bidex_meta.runs import RunFolder
from bidex_meta.runs.atomic import Json, check_writable, write_atomic
from bidex_meta.training.learner import Capability
from bidex_meta.utils.files import portable
from bidex_meta.utils.validation import parse as parse_content
from bidex_meta.worlds import open_worlds

TOLERANCE = 1e-5
"""Largest allowed difference between an action of the file and torch's action."""
ROWS = 256
"""Number of random observations in the check; the export itself uses another batch size."""
_SHAPE = dict[str, Any]


@dataclass(frozen=True)
class Export:
    """The result of :func:`export`."""

    path: Path
    size: int
    """Size of the file, bytes."""
    gap: float
    """Largest difference between the file's actions and torch's actions in float32."""
    gap_as_played: float
    """Largest difference between the file's actions and the policy's actions on this machine, which may use
    bfloat16."""


def export(run: str | Path, out: Path | None = None, *, checkpoint: str = "last") -> Export:
    """Write a run's policy as an ONNX file: raw observations in, mean actions out, float32.

    ``out`` is the file; the default is ``policy.onnx`` in the run's folder. Raises BidexError for policies that have a
    memory or adapt, and if the file's actions differ from those of torch.
    """
    if missing := [name for name in ("onnx", "onnxscript", "onnxruntime") if find_spec(name) is None]:
        raise BidexError(f"bidex-meta export needs {', '.join(missing)}: pip install 'bidex-meta[export]'.")
    folder = RunFolder.open(run)
    config = replace(folder.config(), device="cpu")
    if Capability.ADAPTS in learner_kind(config.algo).capabilities:
        raise BidexError(
            f"{config.algo} adapts to tasks or remembers, and an ONNX file maps one observation to one action. "
            "Export a policy that does not adapt, such as one of mtppo, mtsac, td3, mappo, dagger or bc."
        )
    path = out or folder.path / "policy.onnx"
    check_writable(path)
    state, steps = load_checkpoint(folder, checkpoint)
    policy = policy_of(folder, state, "cpu")
    shape = parse_content(state["learner"]["policy"].get("shape"), _SHAPE, f"{folder.path}: the policy's shape")
    content, gap, gap_as_played = exported(policy, shape, _metadata(folder, config, steps, shape))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, lambda file: file.write(content))
    return Export(path, len(content), gap, gap_as_played)


def exported(policy: Any, shape: Json, metadata: dict[str, str]) -> tuple[bytes, float, float]:
    """Export a policy to ONNX and compare the exported actions with those of torch.

    Returns the content of the ONNX file, which computes in float32, and two numbers. The first is the largest
    difference between an action of the file and torch's action in float32. The second is the largest difference to the
    actions of ``policy`` as it was given, which may compute in bfloat16. ``shape`` is the entry ``shape`` of the
    policy's checkpoint, and ``metadata`` are texts to store in the file.

    Raises BidexError if torch cannot export the policy, or if the first difference is larger than TOLERANCE.
    """
    import onnxruntime

    network: Any = policy
    if not isinstance(policy, torch.nn.Module):
        raise BidexError(f"Expected a policy that is a torch.nn.Module, got {type(policy).__name__}.")
    obs = _observations(ROWS, shape, network)
    as_played = network.eval_action(obs).numpy()
    low_precision = getattr(network, "low_precision", False)
    network.low_precision = False
    # mkldnn would choose a matrix product by the batch size, which the export leaves open.
    with warnings.catch_warnings(action="ignore"), torch.backends.mkldnn.flags(enabled=False):
        try:
            content = _onnx(network, _observations(2, shape, network), metadata)
        except Exception as error:  # the exporter raises many kinds of errors
            raise BidexError(
                f"torch cannot export this policy: {type(error).__name__}, {one_line(error)[:200]}. Its networks may "
                "branch on values of tensors; --debug shows the line."
            ) from error
        wanted = network.eval_action(obs).numpy()
    network.low_precision = low_precision
    try:
        session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
        actions = session.run(None, {"observations": obs.numpy()})[0]
    except Exception as error:  # onnxruntime raises many kinds of errors
        raise BidexError(
            f"onnxruntime cannot play what torch has exported for {ROWS} observations: {one_line(error)[:200]}. Export "
            "fails."
        ) from error
    gap = float(abs(actions - wanted).max())
    if not gap <= TOLERANCE:
        raise BidexError(
            f"The exported actions differ from torch's by {gap:.2g}, more than {TOLERANCE:g}. Export fails."
        )
    return content, gap, float(abs(actions - as_played).max())


def check_export(folder: RunFolder, path: Path) -> None:
    """Raise BidexError unless an ONNX file can be read and its policy has the steps of a run's newest checkpoint."""
    mend = f"Write it again: bidex-meta export {folder.path}, or delete it."
    try:
        import onnxruntime
    except ImportError:
        raise BidexError(f"{path} is read by onnxruntime: pip install 'bidex-meta[export]'. Or delete it.") from None
    try:
        session = onnxruntime.InferenceSession(path.read_bytes(), providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime raises many kinds of errors
        raise BidexError(f"{path}: expected an ONNX file, got {one_line(error)[:100]}. {mend}") from None
    exported_steps = session.get_modelmeta().custom_metadata_map.get("steps")
    _, steps = load_checkpoint(folder)
    if exported_steps != str(steps):
        raise BidexError(f"{path}: expected the newest policy, of {steps} steps, got {exported_steps} steps. {mend}")


def _onnx(policy: Any, obs: torch.Tensor, metadata: dict[str, str]) -> bytes:
    class MeanAction(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.policy = policy

        def forward(self, observations: torch.Tensor) -> torch.Tensor:
            # Some products with zero rows crash onnxruntime's process with SIGFPE, so one row is always added.
            padded = torch.cat([observations, observations.new_zeros(1, observations.shape[1])])
            return self.policy.eval_action(padded)[:-1]

    for name in ("torch.onnx", "onnxscript", "onnx_ir"):
        logging.getLogger(name).setLevel(logging.ERROR)
    program = torch.onnx.export(
        MeanAction(), (obs,), input_names=["observations"], output_names=["actions"],
        dynamic_shapes={"observations": {0: torch.export.Dim("rows")}}, dynamo=True, verbose=False,
    )  # fmt: skip
    if program is None:
        raise TypeError("torch.onnx.export returned no program")
    program.model.metadata_props.update(metadata)
    for node in program.model.graph.all_nodes():
        node.metadata_props.clear()  # the metadata quote lines of code with paths of this machine
    return program.model_proto.SerializeToString()


def _observations(rows: int, shape: Json, policy: Any) -> torch.Tensor:
    """Draw random raw observations (rows, d), float32, with a task's one-hot if the policy reads one.

    If the policy normalises observations, they have the mean and the variance that it knows. Others would be so far
    from those of training that rounding alone moves the actions.
    """
    obs = torch.randn(rows, shape["observations"], generator=torch.Generator().manual_seed(0))
    task = torch.arange(rows)
    for start, stop in shape.get("groups", {}).get("task_id", []):
        obs[:, start:stop] = torch.eye(stop - start)[task % (stop - start)]
    normaliser = getattr(policy, "observations", None)
    # Both are (d,), or (tasks, d) if each task has its own statistics.
    shift = getattr(normaliser, "shift", None)
    scale = getattr(normaliser, "scale", None)
    if shift is None or scale is None:
        return obs
    if shift.ndim == 2:
        row_of = task % len(shift)
        shift = shift[row_of]
        scale = scale[row_of]
    return shift + obs / scale


def _metadata(folder: RunFolder, config: RunConfig, steps: int, shape: Json) -> dict[str, str]:
    """Return the metadata of the ONNX file as strings; numbers, lists and dicts are written as JSON."""
    worlds = open_worlds(config.to_json())
    versions = folder.versions()
    facts = {
        "suite": portable(worlds.name), "suite_version": worlds.identity()["suite_version"], "algorithm": config.algo,
        "classes": list(worlds.tasks("train")), "seed": config.seed, "steps": steps,
        "commit": (versions.get("git") or {}).get("commit"), "versions": versions.get("packages"),
        "observation_groups": shape.get("groups"),
    }  # fmt: skip
    return {name: value if isinstance(value, str) else json.dumps(value) for name, value in facts.items()}
