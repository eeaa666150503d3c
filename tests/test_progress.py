"""Progress: a bar where it is asked for, with the time that is left where shares are known."""

import re

from coax_env.progress import Progress, bar, reporter, shows_progress


def test_what_is_left_is_in_proportion_to_what_has_passed(capsys):
    with bar("work", {"first": 0.0, "second": 0.5, "third": 0.75}) as report:
        report("first step")
        report("second step")
    text = capsys.readouterr().err
    assert "work: second step" in text
    assert re.search(r"about \d\d:\d\d left", text)


def test_a_step_that_comes_again_takes_nothing_back(capsys):
    with bar("work", {"first": 0.0, "second": 0.5}) as report:
        for line in ("first", "second", "first"):
            report(line)
        bars = capsys.readouterr().err.rpartition("work: first")[2]
    assert "\u2588" in bars or "#" in bars  # half of it stays full


@shows_progress("work")
def work(count: int, progress: Progress | bool | None = None) -> int:
    report = reporter(progress)
    for k in range(count):
        report(f"step {k}")
    return count


def test_true_shows_a_bar_and_nothing_else_does(capsys):
    assert work(2) == 2
    lines: list[str] = []
    assert work(2, lines.append) == 2 and lines == ["step 0", "step 1"]
    assert capsys.readouterr().err == ""
    assert work(2, progress=True) == 2
    assert "work: step 1" in capsys.readouterr().err
