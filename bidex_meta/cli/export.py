"""``bidex-meta export``: write a run's policy as one ONNX file, checked against torch."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bidex_meta.cli.parsing import RunPath, parse
from bidex_meta.experiments.exporting import ROWS, TOLERANCE, export


@dataclass(frozen=True)
class ExportFlags:
    """Write a run's policy as ONNX: raw observations (N, d) in, mean actions (N, a) in [-1, 1] out, float32.

    Example: bidex-meta export assets/policies/MT20-v2 --out mt20.onnx

    The file contains the running statistics of observations. Policies that have a memory or adapt are refused. The file
    computes in float32; for a policy that computes in bfloat16 on this machine, the command prints the largest
    difference.
    """

    run: RunPath  # Folder of the run to export.
    out: Path | None = None  # ONNX file to write; None: policy.onnx in the run's folder.
    checkpoint: str = "last"  # Checkpoint to export: last, best or a file.


def main(arguments: Sequence[str]) -> None:
    """Export, check and print the file's path."""
    flags = parse(ExportFlags, arguments, "export")
    found = export(flags.run, flags.out, checkpoint=flags.checkpoint)
    print(
        f"{found.path}: {found.size / 1e6:.1f} MB, within {found.gap:.1g} of torch in float32 on {ROWS} random "
        "observations"
    )
    if found.gap_as_played > TOLERANCE:
        print(
            "On this machine the run's policy computes in bfloat16: on these observations its actions are up to "
            f"{found.gap_as_played:.1g} away."
        )
