"""Tables and text about the content of data sets."""

from dataclasses import asdict

from bidex_meta.data.checking import Findings, coverage, summary
from bidex_meta.data.dataset import Dataset, data_folder, dataset_names, open_dataset
from bidex_meta.errors import BidexError
from bidex_meta.runs.atomic import Json


def list_rows() -> tuple[list[Json], list[str]]:
    """Return a row of the table for each data set, and an error message for each data set that cannot be read."""
    rows: list[Json] = []
    errors = []
    for name in dataset_names():
        try:
            dataset = open_dataset(data_folder() / name)
        except BidexError as error:
            errors.append(f"{name}: {error}")
            continue
        about = dataset.metadata
        rows.append(
            {
                "name": name,
                "kind": about.get("kind"),
                "source": about.get("suite") or about.get("task"),
                "transitions": dataset.num_steps,
                "episodes": dataset.num_episodes,
                "megabytes": dataset.content.get("dataset_size"),
            }
        )
    return rows, errors


def description(dataset: Dataset) -> Json:
    """Return sizes, classes, coverage and origin of a data set, ready for JSON."""
    about = {name: value for name, value in dataset.metadata.items() if name != "observation_groups"}
    sizes = {"observations": dataset.observation_size, "actions": dataset.action_size}
    totals = {"name": dataset.name, "transitions": dataset.num_steps, "episodes": dataset.num_episodes, **sizes}
    classes = [asdict(slot) for slot in summary(dataset)]
    return {**totals, "classes": classes, "coverage": coverage(dataset), **about}


def origin_lines(found: Json) -> list[str]:
    """Return lines of text about a data set's sizes and origin.

    ``found`` is the result of :func:`description`.
    """
    policies = found.get("policies", [])
    acted = ", ".join(f"{policy.get('algo') or 'uniform'} ({policy.get('actions')} actions)" for policy in policies)
    left_out = found.get("left_out", {})
    left = ", ".join(f"{count:,} {name.replace('_', ' ')}" for name, count in left_out.items() if count)
    sizes = {name: found[name] for name in ("observations", "actions")}
    return [
        f"{found['name']}: {found['kind']} data of {found.get('suite') or found.get('task') or 'elsewhere'}",
        f"{found['transitions']:,} transitions, {found['episodes']:,} episodes; {sizes}; commit {found.get('commit')}",
        f"Acted: {acted or 'unknown'}. Left out: {left or 'nothing'}.",
    ]


def class_row(slot: Json) -> Json:
    """Return a row of text about one class, from the entry ``classes`` of :func:`description`."""
    return {
        "class": slot["name"],
        "episodes": slot["episodes"],
        "transitions": slot["steps"],
        "length": f"{slot['length']:.1f}",
        "return: least, median, mean, largest": " ".join(f"{value:.4g}" for value in slot["returns"]),
        "success": f"{100 * slot['success']:.1f} %",
        "score": "–" if slot["score"] is None else f"{slot['score']:.1f}",
        "tasks": slot["tasks"],
        "broken": slot["broken"],
    }


def coverage_lines(spread: Json) -> list[str]:
    """Return lines of text about how widely the states and actions of a data set are spread.

    ``spread`` is the entry ``coverage`` of :func:`description`.
    """
    groups = ", ".join(f"{name} {value:.3g}" for name, value in spread["observation_std"].items())
    at_bounds = f"{100 * spread['action_at_bounds']:.1f} % at a bound"
    return [
        f"Spread (standard deviation over states, mean over entries): {groups}",
        f"Actions: standard deviation {spread['action_std']:.3g}, {at_bounds}",
    ]


def findings_lines(findings: Findings) -> list[str]:
    """Return lines of text about the result of the check of a data set."""
    lines = [f"{findings.episodes:,} episodes of {findings.steps:,} transitions checked, {findings.count:,} wrong."]
    for name, count in findings.recomputed.items():
        lines.append(f"{name}: {count:,} rewards computed again, largest difference {findings.largest[name]:.2g}")
    lines += [f"{name}: rewards not computed again: {reason}" for name, reason in findings.skipped.items()]
    if findings.unsealed:
        lines.append(f"Files without a digest, from elsewhere: {len(findings.unsealed):,}.")
    return [*lines, *findings.wrong]
