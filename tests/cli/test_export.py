"""``bidex-meta export``: the file does what torch does, says what it is, and what it cannot hold is refused."""

import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from bidex_algos.nets.shape import Shape
from bidex_meta.errors import BidexError
from bidex_meta.experiments import exporting as export
from bidex_meta.experiments.exporting import exported
from bidex_meta.experiments.learners import learner_kind
from bidex_meta.runs import RunFolder
from bidex_meta.world.contract import ObservationGroup
from tests.fakes import trained_run
from tests.pages import ROOT

onnx = pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")
GROUPS = {"joints": [(0, 6)], "object": [(6, 9), (11, 13)], "goal": [(9, 11)], "task_id": [(13, 16)]}
SHAPE = Shape(16, 4, tuple(ObservationGroup(name, tuple(slice(*w) for w in where)) for name, where in GROUPS.items()))


def policy(algo: str, shape: Shape = SHAPE, **options: object) -> torch.nn.Module:
    """A policy with statistics and weights of its own."""
    kind, drawn = learner_kind(algo), torch.Generator().manual_seed(0)
    config = replace(next(iter(kind.presets.values())), **options)
    made = kind.learner_class._make_policy(config, shape, drawn, torch.device("cpu"))  # type: ignore[attr-defined]
    for weight in made.parameters():
        weight.data.add_(0.1 * torch.randn(weight.shape, generator=drawn))
    made.observations.update(3.0 * torch.randn(64, shape.observations, generator=drawn) + 1.0)
    return made


POLICIES: list[tuple[str, dict[str, object]]] = [
    ("mtsac", {"architecture": "towers"}), ("mtppo", {"architecture": "soft_modules"}),
    ("mtppo", {"architecture": "transformer", "hidden": (8,)}),
    ("dagger", {"architecture": "moore", "normalise_per_task": True}),
    ("mappo", {"agents": "a=action/0+action/1;b=action/2+action/3"}), ("bcq", {}), ("iql", {}),
]  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("onnx")


@pytest.mark.parametrize("number", range(len(POLICIES)))
def test_a_file_does_what_torch_does_for_any_number_of_rows(number: int, folder: Path) -> None:
    algo, options = POLICIES[number]
    made = policy(algo, **{"hidden": (8, 8), **options})
    content, gap, _ = exported(made, SHAPE.state_dict(), {"suite": "mine"})
    (folder / f"{number}.onnx").write_bytes(content)
    assert gap < 1e-5
    assert str(ROOT).encode() not in content and b".py" not in content
    obs = torch.randn(5, 16)
    obs[:, 13:] = torch.eye(3)[[0, 2, 1, 1, 0]]
    (actions,) = onnxruntime.InferenceSession(content).run(None, {"observations": obs.numpy()})
    made.low_precision = False  # on a CPU with AVX-512 BF16 the policy itself computes in bfloat16
    wanted = made.eval_action(obs)  # type: ignore[operator]
    assert wanted.std() > 0.05
    torch.testing.assert_close(torch.from_numpy(actions), wanted, atol=1e-5, rtol=0.0)


@pytest.mark.parametrize(("points", "size"), [(16, 48), (64, 192)])
def test_files_of_policies_that_see_clouds_take_any_number_of_rows(points: int, size: int) -> None:
    groups = (ObservationGroup("joints", (slice(0, 6),)), ObservationGroup("points", (slice(6, 6 + size),)))
    shape = Shape(6 + size, 4, groups)
    made = policy("mtppo", shape, hidden=(8,))
    content, *_ = exported(made, shape.state_dict(), {})
    obs = torch.randn(1500, 6 + size)  # so many clouds that torch's network splits them
    (actions,) = onnxruntime.InferenceSession(content).run(None, {"observations": obs.numpy()})
    made.low_precision = False
    wanted = made.eval_action(obs)  # type: ignore[operator]
    torch.testing.assert_close(torch.from_numpy(actions), wanted, atol=1e-5, rtol=0.0)


def test_a_file_that_onnxruntime_cannot_play_is_refused_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(export, "_onnx", lambda *_: b"nothing")
    with pytest.raises(BidexError, match="onnxruntime cannot play what torch has exported for 256 observations"):
        exported(policy("bcq", hidden=(8, 8)), SHAPE.state_dict(), {})


def test_no_rows_end_no_process(folder: Path) -> None:
    """Of any file that the test above has written."""
    files = sorted(map(str, folder.iterdir()))
    code = (
        "import sys, numpy, onnxruntime; sessions = map(onnxruntime.InferenceSession, sys.argv[1:]); "
        "print([s.run(None, {'observations': numpy.zeros((0, 16), numpy.float32)})[0].shape for s in sessions])"
    )
    done = subprocess.run([sys.executable, "-c", code, *files], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, f"{[(0, 4)] * len(files)}\n")


def test_the_difference_to_a_policy_in_bfloat16_is_told(shown, tmp_path: Path, monkeypatch) -> None:
    made = policy("mtppo", hidden=(8, 8), autocast="on")
    _, gap, as_played = exported(made, SHAPE.state_dict(), {})
    assert gap < 1e-5 < 1e-4 < as_played and made.low_precision
    monkeypatch.setattr(export, "exported", lambda *_: (b"file", 7e-6, 0.038))
    told = shown("export", trained_run("mtppo"), "--out", tmp_path / "policy.onnx")
    assert "within 7e-06 of torch in float32" in told
    assert "policy computes in bfloat16: on these observations its actions are up to 0.04 away" in told


def test_a_policy_whose_file_would_differ_is_refused() -> None:
    class Drawn(torch.nn.Module):
        def eval_action(self, obs: torch.Tensor) -> torch.Tensor:
            return obs[:, :4] if torch.compiler.is_exporting() else 1e-4 + obs[:, :4]

    with pytest.raises(BidexError, match=r"differ from torch's by 0\.0001"):
        exported(Drawn(), SHAPE.state_dict(), {})


def test_a_run_exports_with_its_name_tag(shown, tmp_path: Path) -> None:
    run, out = trained_run("mtppo"), tmp_path / "policy.onnx"
    assert "of torch in float32 on 256 random observations" in shown("export", run, "--out", out)
    model = onnx.load(out)
    said = {entry.key: entry.value for entry in model.metadata_props}
    assert (said["suite"], said["algorithm"], said["seed"]) == ("MT4", "mtppo", "3")
    assert "CatchUnderarm" in said["classes"] and said["versions"].startswith("{")
    (entry,) = model.graph.input
    assert entry.type.tensor_type.shape.dim[0].dim_param and entry.type.tensor_type.shape.dim[1].dim_value > 400


def test_a_file_of_an_older_policy_or_a_damaged_one_is_not_pushed(shown, refused, tmp_path: Path) -> None:
    run, hub = Path(shutil.copytree(trained_run("mtppo"), tmp_path / "run")), f"folder:{tmp_path / 'hub'}"
    shown("export", run)
    shown("push", run, f"folder:{tmp_path / 'first'}")
    assert (tmp_path / "first" / "policy.onnx").is_file()
    checkpoints = RunFolder.open(run).checkpoints
    state, step = checkpoints.load()  # type: ignore[misc]
    checkpoints.save(state, step + 8)
    said = refused("push", run, hub)
    assert f"expected the newest policy, of {step + 8} steps, got {step} steps. Write it again: bidex-meta" in said
    (run / "policy.onnx").write_bytes((run / "policy.onnx").read_bytes()[:1000])
    said = refused("push", run, hub)
    assert "expected an ONNX file" in said and said.count("\n") == 1 and not (tmp_path / "hub").exists()


def test_what_adapts_is_refused_in_one_line(refused, tmp_path: Path) -> None:
    said = refused("export", trained_run("rl2"), "--out", tmp_path / "x.onnx")
    assert "rl2 adapts to tasks or remembers" in said and "Export a policy that does not adapt" in said
    assert not (tmp_path / "x.onnx").exists()
