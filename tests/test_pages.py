"""Code in the pages: Python blocks run on tiny worlds, command lines are parsed, links lead somewhere."""

import ast
import contextlib
import importlib
import importlib.util
import io
import os
import re
import shlex
import subprocess
import tomllib
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
import torch
from gymnasium.spaces import Box

from bidex_meta.cli import COMMANDS, main
from bidex_meta.cli.parsing import flags_of, parse
from bidex_meta.evaluation.play import RandomAgent
from bidex_meta.runs.evaluations import MetaTestEvaluation
from bidex_meta.runs.stored import read_study
from tests.pages import PAGES, ROOT, blocks, files_of
from tools.english import prose

SMALLER = (
    # Rows and steps of the examples, as few as their worlds allow; what the pages say of shapes stays out of it.
    (r"num_envs=(256|1024)\b", "num_envs=4"),
    (r"num_envs=(300|40)\b", "num_envs=15"),
    (r"\.learn\(\S+\)", ".learn(64)"),
    (r"rollouts=10, device", "rollouts=1, device"),
    (r"adaptation_episodes=\d+", "adaptation_episodes=1"),
)


class Adapting(RandomAgent):
    """Stands for the ``agent`` that a page supposes: it adapts to nothing."""

    def adapt_action(self, obs: torch.Tensor) -> tuple[torch.Tensor, dict[str, object]]:
        return self.eval_action(obs), {}

    def eval_action(self, obs: torch.Tensor) -> torch.Tensor:
        return torch.zeros(len(obs), 52)

    def assign(self, task_of_row: object) -> None: ...
    def init(self) -> None: ...
    def step(self, timestep: object) -> None: ...
    def adapt(self) -> None: ...


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with every file that the pages show."""
    for page in PAGES:
        for name, text in files_of(page).items():
            (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


PYTHON = [page for page in PAGES if any(block.language == "python" for block in blocks(page))]


@pytest.mark.parametrize("page", PYTHON, ids=lambda page: str(page.relative_to(ROOT)))
def test_python_blocks_run(page: Path, folder: Path) -> None:
    names: dict[str, object] = {"agent": Adapting(Box(-1.0, 1.0, (1, 52))), "__name__": "page"}
    with contextlib.redirect_stdout(io.StringIO()):
        for block in blocks(page):
            if block.mark.startswith("needs "):
                pytest.importorskip(block.mark.split()[1])
            if block.language == "python" and not block.mark.startswith(("file ", "skip ")):
                text = block.text
                for pattern, fewer in SMALLER:
                    text = re.sub(pattern, fewer, text)
                exec(compile(text, str(page), "exec"), names)


@pytest.mark.parametrize("name", ["test_my_tasks.py", "test_my_learner.py"])
def test_tests_that_pages_show_pass(name: str, folder: Path) -> None:
    module = importlib.import_module(name.removesuffix(".py"))
    found = [value for key, value in vars(module).items() if key.startswith("test_")]
    assert found
    for test in found:
        test(**({"tmp_path": folder} if test.__code__.co_argcount else {}))


def _lines() -> Iterator[tuple[str, str]]:
    for page in PAGES:
        for block in blocks(page):
            if block.language or block.mark.startswith("skip"):
                continue
            for line in block.text.replace("\\\n", " ").splitlines():
                if found := re.match(r"(?:torchrun .* -m bidex_meta\.cli|bidex-meta) (?P<rest>[^#]*)", line):
                    yield str(page.relative_to(ROOT)), found["rest"].strip()


LINES = sorted({rest: page for page, rest in _lines()}.items())


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with a config, for lines that resume one."""
    path = tmp_path_factory.mktemp("run")
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        assert main(["run", "--suite", "MT4", "--algo", "mtppo", "--print-config"]) == 0
    (path / "config.json").write_text(printed.getvalue())
    return path


@pytest.mark.parametrize("line, page", LINES, ids=[line for line, _ in LINES])
def test_command_lines_parse(line: str, page: str, run: Path, folder: Path) -> None:
    plain = re.sub(r"\|\d+", "", line.partition(" > ")[0]).replace("cuda:0", "cpu")
    plain = re.sub(r"runs/\S+|<[^>]*>|\bRUN\b", str(run), plain)
    name, *arguments = [word for word in shlex.split(plain) if word not in ("--help", "--help-all")]
    assert name in COMMANDS, f"{page}: there is no bidex-meta {name}"
    command = importlib.import_module(COMMANDS[name].module).main
    found = flags_of(command, arguments)
    parse(found.options, arguments, name, found.default)


@pytest.mark.parametrize("code, asked", [(0, ""), (2, ""), (138, "requeue 7\n")])
@pytest.mark.parametrize(
    "given, started",
    [
        ("runs/new --suite MT4-v2", "run --run-dir runs/new --suite MT4-v2"),
        ("runs/old --suite MT4-v2", "run --resume runs/old"),
        ("my.toml --workers 8", "sweep my.toml --workers 8"),
    ],
)
def test_the_job_of_a_cluster_resumes_and_is_queued_again(
    given: str, started: str, code: int, asked: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, body in (("srun", f"echo $@ >> started; exit {code}"), ("scontrol", "echo $@ >> asked")):
        (folder / name).write_text(f"#!/bin/sh\n{body}\n")
        (folder / name).chmod(0o755)
    (folder / "runs" / "old").mkdir(parents=True)
    (folder / "runs" / "old" / "config.json").touch()
    (folder / "asked").touch()
    monkeypatch.setenv("PATH", f"{folder}:{os.environ['PATH']}")
    monkeypatch.setenv("SLURM_JOB_ID", "7")
    done = subprocess.run(["bash", "job.sh", *given.split()], check=False)
    assert done.returncode == (0 if asked else code)
    assert (folder / "started").read_text() == f"bidex-meta {started}\n" and (folder / "asked").read_text() == asked


LINK = re.compile(r"\]\((?!https?://|#)(?P<path>[^)#\s]+)?(?:#(?P<anchor>[^)\s]+))?\)")


def _anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as GitHub makes them."""
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    titles = [re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", title) for title in re.findall(r"^#+ (.*)$", text, re.MULTILINE)]
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    for found in LINK.finditer(page.read_text(encoding="utf-8")):
        target = page.parent / (found["path"] or page.name)
        assert target.exists(), f"{page.name}: {found[0]} leads nowhere"
        if found["anchor"] and target.suffix == ".md":
            assert found["anchor"] in _anchors(target), f"{page.name}: {target.name} has no {found['anchor']}"


def test_extras_that_pages_and_messages_name_exist() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for path in (
        *PAGES,
        *(path for folder in ("bidex_meta", "algos", "examples") for path in (ROOT / folder).rglob("*.py")),
    ):
        text = path.read_text(encoding="utf-8")
        named = [name.strip() for each in re.findall(r"bidex-meta\[([\w, -]+)\]", text) for name in each.split(",")]
        for rest in re.findall(r"needs the extra (`[^.]*)", text):
            named += [name for name in re.findall(r"`+([\w-]+)`+", rest) if name not in COMMANDS]
        assert set(named) <= extras.keys(), f"{path}: {named}"


def _strings(path: Path) -> Iterator[str]:
    """Yield every string of a module, with … in place of the values of an f-string."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.JoinedStr):
            yield "".join(str(part.value) if isinstance(part, ast.Constant) else "…" for part in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def test_messages_of_troubleshooting_are_in_the_code() -> None:
    page = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
    messages = re.findall(r"^\| `([^`]*)` \|", page, re.MULTILINE)
    assert len(messages) > 20
    modules = [path for folder in ("bidex_meta", "algos") for path in (ROOT / folder).rglob("*.py")]
    code = "\n".join(text for path in modules for text in _strings(path))
    for message in messages:
        parts = map(re.escape, message.split("…"))
        assert re.search(".*".join(parts), code), f"troubleshooting.md: no message {message!r}"


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) < 601


def _prose(page: Path) -> int:
    """Words of a page outside of code blocks, comments, tables and image lines."""
    return len(re.findall(r"[\w][\w'’./-]*", prose(page.read_text(encoding="utf-8"))))


def test_readme_says_what_the_ladder_found() -> None:
    found: dict[str, list[float]] = {}
    for run in read_study(ROOT / "results" / "data" / "ladder-rung1.json"):
        evaluation = run.evaluation()
        if isinstance(evaluation, MetaTestEvaluation):
            (last,) = evaluation.splits["test"].by_shot[-1].classes.values()
            found.setdefault(run.arm, []).append(100 * last.success)
    icl, varibad, maml = (sum(found[name]) / len(found[name]) for name in ("icl", "VariBAD", "MAML"))
    told = f"in-context learning {icl:.0f} %, VariBAD {varibad:.0f} %, MAML {maml:.0f} %"
    assert told in (ROOT / "README.md").read_text()


def test_the_documentation_is_short() -> None:
    words = {page: _prose(page) for page in (ROOT / "docs").rglob("*.md") if page.parent.name != "notes"}
    assert sum(words.values()) <= 17_000, sorted(words.items(), key=lambda item: -item[1])[:8]


def test_workflows_call_make_targets_and_use_supported_pythons() -> None:
    text = "".join(path.read_text() for path in (ROOT / ".github" / "workflows").glob("*.yml"))
    targets = re.search(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert targets
    called = {*re.findall(r"make ([\w-]+)", text), *re.findall(r"target: \[(.*)\]", text)[0].split(", ")}
    assert called <= set(targets[1].split()) and {"test", "docs", "dist", "bench", "test-all"} <= called
    supported = set(re.findall(r"Python :: (3\.\d+)", (ROOT / "pyproject.toml").read_text()))
    assert set(re.findall(r'"(3\.\d+)"', text)) <= supported


def test_commits_are_checked_by_the_pinned_ruff() -> None:
    revision = re.search(r"ruff-pre-commit\n +rev: v(.*)", (ROOT / ".pre-commit-config.yaml").read_text())
    assert revision and f"\nruff=={revision[1]}\n" in (ROOT / "constraints.txt").read_text()


@pytest.fixture
def build(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    spec = importlib.util.spec_from_file_location("site_build", ROOT / "docs" / "site" / "build.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "STAGE", tmp_path / "pages")
    return module


def test_navigation_has_every_page_once(build: ModuleType) -> None:
    pages = sorted(page.relative_to(ROOT).as_posix() for page in build.stage())
    config = (ROOT / "docs" / "site" / "mkdocs.yml").read_text(encoding="utf-8")
    assert sorted(re.findall(r"[\w/-]+\.md\b", config.partition("\nnav:")[2])) == pages


def test_what_pages_link_to_is_staged(build: ModuleType) -> None:
    build.stage()
    for page in build.STAGE.rglob("*.md"):
        for found in build.LINK.finditer(page.read_text(encoding="utf-8")):
            assert (page.parent / found[2]).is_file(), f"{page.name}: {found[0]}"


def test_mkdocs_builds_it_and_it_loads_nothing_from_elsewhere(build: ModuleType, tmp_path: Path) -> None:
    mkdocs_config = pytest.importorskip("mkdocs.config", reason="needs the extra docs: `make docs`")
    pytest.importorskip("material", reason="needs the extra docs")
    from mkdocs.commands.build import build as make  # pyright: ignore[reportMissingImports]

    build.stage()
    config = ROOT / "docs" / "site" / "mkdocs.yml"
    made = tmp_path / "site"
    make(mkdocs_config.load_config(str(config), docs_dir=str(build.STAGE), site_dir=str(made)))
    for page in made.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        assert not re.search(r"<(?:script|link|img|iframe)[^>]*(?:src|href)=\"?https?:", text), page
        assert 'class="mermaid"' not in text, "mermaid's script would be loaded from a network"
