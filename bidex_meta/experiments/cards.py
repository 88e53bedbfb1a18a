"""Make the model card of a published run, and the data card of a published data set.

A card is the README.md of a repository on the Hugging Face Hub. It begins with the Hub's metadata in YAML. All its
content comes from the files of the published folder.
"""

import json

from bidex_meta.data import Dataset
from bidex_meta.errors import one_line
from bidex_meta.runs import RunFolder
from bidex_meta.runs.atomic import Json
from bidex_meta.runs.evaluations import ClassSummary, MetaTestEvaluation, PolicyEvaluation, unusual_settings
from bidex_meta.runs.provenance import versions_of
from bidex_meta.runs.versions import Versions, parse_versions
from bidex_meta.utils.files import portable


def run_card(folder: RunFolder, name: str) -> str:
    """Return the text of the README.md that describes a run's policy on the Hugging Face Hub.

    It has the Hub's metadata in YAML, commands, facts about the run, and results.
    """
    config = folder.config()
    versions = versions_of(folder)
    subject = portable(config.suite or str(config.task))
    loaded = folder.checkpoints.load()
    steps = loaded[1] if loaded else 0
    evaluation = folder.evaluation() if folder.evaluated else None
    classes: dict[str, ClassSummary] = {}
    results = ""
    played = subject
    if evaluation is not None and evaluation.steps != steps:
        results = "\nThe results are left out, because evaluation.json is not of the newest checkpoint.\n"
    elif isinstance(evaluation, PolicyEvaluation):
        classes = evaluation.policy.classes
        played = ", ".join([subject, *unusual_settings(evaluation)])
        results = f"\nResults of the policy of {steps:,} steps on {played}:\n{_table(classes)}"
    elif isinstance(evaluation, MetaTestEvaluation):
        for split, part in evaluation.splits.items():
            played = ", ".join([f"{split} tasks of {subject}", *unusual_settings(evaluation)])
            results += f"\nResults on {played}, before adaptation:\n{_table(part.before.classes)}"
            results += f"\nAfter {part.shots} shots of {part.rollouts} episodes:\n{_table(part.after.classes)}"
    mean = sum(row.success for row in classes.values()) / max(len(classes), 1)
    found = [{"type": "success rate", "value": round(mean, 4), "name": "mean over classes"}]
    header = {
        "library_name": "bidex-meta", "license": "apache-2.0", "pipeline_tag": "reinforcement-learning",
        "tags": ["reinforcement-learning", "bidex-meta", "mujoco", subject, config.algo],
        "model-index": [{"name": name, "results": [{
            "task": {"type": "reinforcement-learning"}, "dataset": {"name": played, "type": subject}, "metrics": found,
        }]}],
    }  # fmt: skip
    if not classes:
        del header["model-index"]
    facts = {
        "suite or class": subject, "algorithm": config.algo, "preset": config.preset, "all settings": "config.json",
        "seed": config.seed, "steps": f"{steps:,}", **_made(versions),
    }  # fmt: skip
    if episodes := [row.episodes for row in classes.values() if row.episodes]:
        facts["evaluated on"] = f"{max(episodes)} episodes of a class"
    title = f"{config.algo} on {subject}, seed {config.seed}"
    plays = f"bidex-meta pull {name} --out policy\nbidex-meta evaluate policy"
    return _card(header, title, plays, facts) + results


def data_card(dataset: Dataset, name: str) -> str:
    """Return the text of the README.md that describes a data set on the Hugging Face Hub.

    It has the Hub's metadata in YAML, commands, and facts about the data set.
    """
    ours = portable(dataset.metadata)
    tasks = ours["tasks"]
    header = {
        "license": "apache-2.0", "task_categories": ["reinforcement-learning"],
        "tags": ["bidex-meta", "minari", "offline-rl", "mujoco", *tasks[:1]],
    }  # fmt: skip
    versions = parse_versions(ours.get("versions") or {}, f"{dataset.folder}: versions")
    facts = {
        "data set": dataset.name, "kind": ours["kind"], "classes": ", ".join(tasks),
        "transitions": f"{dataset.num_steps:,}", "episodes": f"{dataset.num_episodes:,}", **_made(versions),
    }  # fmt: skip
    use = f"bidex-meta pull {name} --out data-set\nbidex-meta data info data-set"
    return _card(header, dataset.name, use, facts)


def _made(versions: Versions) -> Json:
    made = {"commit": versions.git.commit if versions.git else None}
    made |= {name: versions.packages.get(name) for name in ("bidex-meta", "mujoco", "torch")}
    return {key: value for key, value in made.items() if value}


def _card(header: Json, title: str, use: str, facts: Json) -> str:
    # Every line of JSON is also a line of YAML.
    lines = [f"{key}: {json.dumps(value, ensure_ascii=False)}" for key, value in header.items()]
    table = "\n".join(f"| {key} | {_cell(value)} |" for key, value in facts.items())
    return "\n".join(
        ["---", *lines, "---", f"\n# {one_line(title)}\n", f"```\n{use}\n```\n", "| | |\n|---|---|", table, ""]
    )


def _cell(value: object) -> str:
    """Format a value as a cell of a Markdown table, on one line and with escaped vertical bars.

    Without this, names from other people's metadata could break the table.
    """
    return one_line(value).replace("|", "\\|")


def _table(classes: dict[str, ClassSummary]) -> str:
    lines = []
    for name, row in classes.items():
        lines.append(f"| {_cell(name)} | {100 * row.success:.1f} % | {row.mean_return:.4g} |")
    return "\n".join(["", "| class | success | return |", "|---|---|---|", *lines, ""])
