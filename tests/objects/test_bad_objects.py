"""What is no object for a hand: one line that says so, before a world is built or a folder written."""

import os
from collections.abc import Iterator
from pathlib import Path

import mujoco
import pytest

from bidex_meta import BidexError
from bidex_meta.cli import main
from bidex_meta.tasks import registry

GEOM = '<geom type="box" size="0.03 0.03 0.03" mass="0.1"/>'


def mjcf(inside: str, before: str = "", body: str = "<body>{}</body>") -> str:
    return f"<mujoco>{before}<worldbody>{body.format(inside)}</worldbody></mujoco>"


def mesh(file: str) -> str:
    return mjcf('<geom type="mesh" mesh="m"/>', f'<asset><mesh name="m" file="{file}"/></asset>')


BOMB = (
    '<!DOCTYPE m [<!ENTITY a "'
    + "x" * 1000
    + '">'
    + "".join(f'<!ENTITY b{i} "{f"&b{i - 1};" * 10 if i else "&a;" * 10}">' for i in range(9))
    + f"]><mujoco model='&b8;'><worldbody><body>{GEOM}</body></worldbody></mujoco>"
)

BAD = {
    "no body": (mjcf(GEOM, body="{}"), "one <body> with geoms, got 0"),
    "an empty body": (mjcf(""), "got none. Add its shape"),
    "two bodies": (mjcf(GEOM, body="<body>{0}</body><body pos='0 0 1'>{0}</body>"), "one <body> with geoms, got 2"),
    "a body in a body": (mjcf(f"{GEOM}<body>{GEOM}</body>"), "one <body> with geoms, got 2"),
    "a geom beside it": (mjcf(GEOM, body=f"<body>{{}}</body>{GEOM}"), "inside the body"),
    "a hinge": (mjcf(f"<joint name='lid' type='hinge'/>{GEOM}"), "without joints, got lid"),
    "a hundred kilograms": (mjcf(GEOM.replace("0.1", "100")), "mass of 0.002 to 2 kg, got 100"),
    "no mass": (mjcf(GEOM.replace("0.1", "1e-9")), "mass of 0.002 to 2 kg"),
    "larger than a hand": (mjcf(GEOM.replace("0.03 0.03 0.03", "0.03 0.03 0.2")), "fits a hand, got 40 cm"),
    "in millimetres": (mjcf(GEOM.replace("0.03 0.03 0.03", "30 30 30")), "MJCF is in metres"),
    "a crumb": (mjcf(GEOM.replace("0.03 0.03 0.03", "0.001 0.001 0.001")), "1 to 25 cm"),
    "a size below zero": (mjcf(GEOM.replace("0.03 0.03 0.03", "0.03 -0.03 0.03")), "MuJoCo says"),
    "a size that is none": (mjcf(GEOM.replace("0.03 0.03 0.03", "0.03 nan 0.03")), "finite numbers, got size="),
    "an infinite mass": (mjcf(GEOM.replace("0.1", "inf")), "finite numbers, got mass='inf'"),
    "no place": (mjcf(GEOM.replace("<geom", "<geom pos='-NaN 0 0'")), "finite numbers, got pos="),
    "an infinite place": (mjcf(GEOM.replace("<geom", "<geom pos='0 -Infinity 0'")), "finite numbers, got pos="),
    "no colour": (mjcf(GEOM.replace("<geom", "<geom rgba='nan(1) 0 0 1'")), "finite numbers, got rgba="),
    "no numbers of a mesh": (mesh('m.obj" scale="nan 1 1'), "finite numbers, got scale="),
    "a mass below zero": (mjcf(GEOM.replace("0.1", "-1")), "MuJoCo says"),
    "a shape elsewhere": (mjcf(GEOM.replace("<geom", "<geom pos='0.06 0 0'")), "origin inside its shape"),
    "only to be seen": (mjcf(GEOM.replace("<geom", "<geom contype='0' conaffinity='0'")), "geoms that collide"),
    "forty geoms": (mjcf(GEOM * 40), "at most 32 geoms"),
    "glue": (mjcf(GEOM.replace("<geom", "<geom friction='100 1 1'")), "friction of 0 to 5, got 100"),
    "friction below zero": (mjcf(GEOM.replace("<geom", "<geom friction='-1'")), "friction of 0 to 5, got -1"),
    "rolling friction below zero": (mjcf(GEOM.replace("<geom", "<geom friction='1 0 -1'")), "of 0 to 5, got -1"),
    "a plane": (mjcf("<geom type='plane' size='0.1 0.1 0.1' mass='0.1'/>"), "mesh, got plane. Replace it"),
    "a plane beside a box": (mjcf(f"{GEOM}<geom type='plane' size='0.1 0.1 0.1'/>"), "mesh, got plane. Replace it"),
    "a body elsewhere": (mjcf(GEOM, body="<body pos='0 0 0.1'>{}</body>"), "a <body> without pos and orientation"),
    "a body by angles": (mjcf(GEOM, body="<body euler='0 90 0'>{}</body>"), "a <body> without pos and orientation"),
    "a body turned": (mjcf(GEOM, body="<body quat='1 1 0 0'>{}</body>"), "a <body> without pos and orientation"),
    "a weight elsewhere": (
        mjcf(f"<inertial pos='0 0 0.05' mass='0.1' diaginertia='1e-4 1e-4 1e-4'/>{GEOM}"),
        "the centre of mass inside the shape",
    ),
    "a mesh that is missing": (mesh("not_there.obj"), "the file not_there.obj next to it"),
    "a mesh from elsewhere": (mesh("../outside.obj"), "files in its own folder"),
    "a folder from elsewhere": (mjcf(GEOM, '<compiler meshdir="/etc"/>'), "meshdir with an absolute path"),
    "an include": (mjcf(GEOM, '<include file="/etc/passwd"/>'), "an object in one file"),
    "a plugin": (mjcf(GEOM, '<extension><plugin plugin="mujoco.sdf.torus"/></extension>'), "<extension>"),
    "an actuator": (mjcf(GEOM, "<actuator/>"), "<actuator>"),
    "a bomb": (BOMB, "document type"),
    "too deep": (mjcf("<body>" * 40 + GEOM + "</body>" * 40), "32 deep"),
    "no XML": ("not xml", "it is not XML"),
    "cut off": (mjcf(GEOM)[:-20], "it is not XML"),
    "nothing": ("", "it is not XML"),
    "no MJCF": ("<robot/>", "<robot>"),
    "an unknown attribute": (mjcf(GEOM.replace("<geom", "<geom weight='3'")), "MuJoCo says"),
}


@pytest.fixture
def loud(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """MuJoCo as before the first engine: it writes warnings to stderr and a log file in the working folder."""
    monkeypatch.chdir(tmp_path)
    mujoco.set_mju_user_warning(None)
    yield
    mujoco.set_mju_user_warning(lambda _: None)


@pytest.mark.parametrize("case", BAD)
def test_a_bad_file_is_one_line(case: str, tmp_path: Path, loud: None, capfd: pytest.CaptureFixture[str]) -> None:
    text, told = BAD[case]
    (tmp_path / "outside.obj").write_text("v 0 0 0\n")
    folder = tmp_path / "mine"
    folder.mkdir()
    file = folder / "thing.xml"
    file.write_text(text)
    with pytest.raises(BidexError) as raised:
        registry.get("CatchUnderarm", True, object=str(file))
    assert told in str(raised.value) and "\n" not in str(raised.value), raised.value
    assert str(file) in str(raised.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine", "outside.obj"], "MuJoCo wrote a log"
    assert not capfd.readouterr().err


@pytest.mark.parametrize("name", ["infinite", "nano", "inf.obj", "Inf-1"])
def test_a_name_may_begin_like_a_number_that_is_none(name: str, tmp_path: Path) -> None:
    file = tmp_path / "thing.xml"
    named = GEOM.replace("<geom", f"<geom name='{name}' material='{name}'")
    file.write_text(mjcf(named, f"<asset><material name='{name}'/></asset>"))
    registry.get("CatchUnderarm", True, object=str(file))


@pytest.mark.parametrize("name", ["crate", "", 3, None, "/no/such/file.xml", "a\0.xml", "a\nb.xml"])
def test_a_bad_name_is_one_line(name: object) -> None:
    with pytest.raises(BidexError):
        registry.get("CatchUnderarm", True, object=name)  # type: ignore[arg-type]


def test_a_pipe_a_folder_and_a_link_that_leads_away(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.xml")
    (tmp_path / "folder.xml").mkdir()
    (tmp_path / "inside").mkdir()
    (tmp_path / "secret.obj").write_text("v 0 0 0\n")
    (tmp_path / "inside" / "link.obj").symlink_to(tmp_path / "secret.obj")
    (tmp_path / "inside" / "linked.xml").write_text(mesh("link.obj"))
    for name, told in (("pipe.xml", "a pipe"), ("folder.xml", "a folder"), ("inside/linked.xml", "its own folder")):
        with pytest.raises(BidexError, match=told):
            registry.get("CatchUnderarm", True, object=str(tmp_path / name))


def test_the_command_says_so_and_writes_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "heavy.xml").write_text(mjcf(GEOM.replace("0.1", "100")))
    run = ["run", "--algo", "ppo", "--steps", "8", "--num-envs", "2"]
    for more, told in (
        (["--task", "CatchUnderarm", "--object", "heavy.xml"], "got 100"),
        (["--task", "CatchUnderarm", "--object", "crate"], "Unknown object 'crate'"),
        (["--task", "PushBlock", "--object", "mug"], "Unknown option of PushBlock 'object'"),
        (["--suite", "MT4", "--object", "mug"], "--object goes with --task"),
    ):
        assert main([*run, *more]) == 2
        error = capsys.readouterr().err
        assert told in error and len(error.strip().splitlines()) == 1, error
    for look in (["--suite", "MT4", "--task", "CatchUnderarm"], []):
        assert main(["render", *look, "--object", "mug", "--out", "mug.png"]) == 2
        assert "--object goes with --task alone" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["heavy.xml"]
