"""Cards of what is published, README.md with the hub's header in YAML, made from a folder alone."""

import json
from pathlib import Path

from bidex_meta.cli.tables import Json
from bidex_meta.runs import RunFolder
from bidex_meta.utils.files import read_json


def run_card(folder: RunFolder, name: str) -> str:
    """The card of a run's policy: the hub's header in YAML, then facts and results."""
    config, versions = folder.config(), folder.versions()
    subject = config.suite or str(config.task)
    classes = _classes(folder)
    mean = sum(row["success"] for row in classes.values()) / max(len(classes), 1)
    found = [{"type": "success rate", "value": round(mean, 4), "name": "mean over classes"}]
    header = {
        "library_name": "bidex-meta", "license": "apache-2.0", "pipeline_tag": "reinforcement-learning",
        "tags": ["reinforcement-learning", "bidex-meta", "mujoco", subject, config.algo],
        "model-index": [{"name": name, "results": [{
            "task": {"type": "reinforcement-learning"}, "dataset": {"name": subject, "type": subject}, "metrics": found,
        }]}],
    }  # fmt: skip
    if not classes:
        del header["model-index"]
    facts = {
        "suite or class": subject, "algorithm": config.algo, "preset": config.preset, "all settings": "config.json",
        "seed": config.seed, "steps": f"{folder.checkpoints.newest_step() or 0:,}", **_made(versions),
    }  # fmt: skip
    if classes:
        facts["evaluated on"] = f"{max(row['episodes'] for row in classes.values())} episodes of a class"
    title = f"{config.algo} on {subject}, seed {config.seed}"
    plays = f"bidex-meta pull {name} --out policy\nbidex-meta evaluate policy"
    return _card(header, title, plays, facts) + _table(classes)


def data_card(folder: Path, name: str) -> str:
    """The card of a data set."""
    content = read_json(folder / "data" / "metadata.json", "a data set's metadata")
    ours: Json = content.get("bidex", {})
    tasks = ours.get("tasks", [])
    header = {
        "license": "apache-2.0", "task_categories": ["reinforcement-learning"],
        "tags": ["bidex-meta", "minari", "offline-rl", "mujoco", *tasks[:1]],
    }  # fmt: skip
    facts = {
        "data set": content["dataset_id"], "kind": ours.get("kind"), "classes": ", ".join(tasks),
        "transitions": f"{content['total_steps']:,}", "episodes": f"{content['total_episodes']:,}",
        **_made(ours.get("versions") or {}),
    }  # fmt: skip
    use = f"bidex-meta pull {name} --out data-set\nbidex-meta data info data-set"
    return _card(header, content["dataset_id"], use, facts)


def _made(versions: Json) -> Json:
    packages, git = versions.get("packages") or {}, versions.get("git") or {}
    made = {"commit": git.get("commit")}
    made |= {each: packages.get(each) for each in ("bidex-meta", "mujoco", "torch")}
    return {key: value for key, value in made.items() if value}


def _card(header: Json, title: str, use: str, facts: Json) -> str:
    # Every line of JSON is one of YAML.
    lines = [f"{key}: {json.dumps(value, ensure_ascii=False)}" for key, value in header.items()]
    table = "\n".join(f"| {key} | {value} |" for key, value in facts.items())
    return "\n".join(["---", *lines, "---", f"\n# {title}\n", f"```\n{use}\n```\n", "| | |\n|---|---|", table, ""])


def _classes(folder: RunFolder) -> Json:
    found = folder.evaluation() if folder.evaluated else {}
    return found.get("policy", found).get("classes", {})


def _table(classes: Json) -> str:
    lines = [f"| {name} | {100 * row['success']:.1f} % | {row['return']:.4g} |" for name, row in classes.items()]
    return "\n".join(["", "| class | success | return |", "|---|---|---|", *lines, ""]) if lines else ""
