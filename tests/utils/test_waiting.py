"""Signs of life, by a clock that the tests turn."""

import pytest

from bidex_meta.utils import waiting


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch):
    """Turns a clock by one second a call, as often as it is told; the watch looks at it each second."""
    now = [100.0]
    watch = waiting._Watch("bidex-meta run, starting", lambda: now[0])
    watch.patience = 4.0
    monkeypatch.setattr(waiting, "_watch", watch)
    monkeypatch.setattr(waiting, "_SECONDS", 14.0)

    def turn(seconds: int) -> None:
        for _ in range(seconds):
            now[0] += 1.0
            watch.look()

    return turn


def test_a_line_within_five_seconds_and_every_fifteen(clock, capsys: pytest.CaptureFixture[str]) -> None:
    clock(5)
    assert capsys.readouterr().err == "bidex-meta run, starting: 4 s so far.\n"
    clock(60)
    assert capsys.readouterr().err.count("\n") == 4


def test_a_line_says_what_it_is_at_and_since_when(clock, capsys: pytest.CaptureFixture[str]) -> None:
    waiting.tell("mtppo on MT4")
    clock(10)
    for step in range(20):
        waiting.note("Playing episodes", f"step {step} of 225")
        clock(1)
    told = capsys.readouterr().err.splitlines()
    lines = ["Playing episodes, step 3 of 225: 4 s so far.", "Playing episodes, step 17 of 225: 18 s so far."]
    assert told == ["mtppo on MT4", *lines]


def test_what_prints_itself_is_not_silent_and_a_pause_can_be_asked_for(clock, capsys) -> None:
    for _ in range(10):
        waiting.told()
        clock(13)
    waiting.note("")
    clock(100)
    assert capsys.readouterr().err == ""


def test_outside_of_a_command_nothing_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    waiting.note("Playing episodes")
    waiting.told()
    assert waiting._watch is None and capsys.readouterr().err == ""


def test_the_watch_of_a_command_ends_with_it(monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    looked = waiting.threading.Event()
    monkeypatch.setattr(waiting, "_LOOK_SECONDS", 0.001)
    monkeypatch.setattr(waiting._Watch, "look", lambda watch: looked.set())
    with waiting.watched("a command"):
        assert looked.wait(60.0)
        assert any(thread.name == "signs of life" for thread in waiting.threading.enumerate())
    assert not any(thread.name == "signs of life" for thread in waiting.threading.enumerate())
