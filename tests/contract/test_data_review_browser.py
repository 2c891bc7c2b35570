"""The review page in a browser: a person's clicks, keys and drags, what they see, and what is on disk after it."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from cqn_data.disk.source import open_source
from cqn_data.review.app import Review, make_app
from cqn_data.review.decided import Desk
from cqn_data.review.recording import Recording
from cqn_data.web.server import PageServer

from .browsing import IN_A_BROWSER, WAIT_MS, browser_fixture  # noqa: F401  # skips where there is no browser
from .columns import ACTION, STATE, TOP, grey, moving, write_columns
from .data_recording import LENGTHS

pytestmark = IN_A_BROWSER
DESK, PHONE = {"width": 1280, "height": 800}, {"width": 390, "height": 844}


@pytest.fixture
def review(recording: Path, tmp_path: Path) -> Review:
    opened = Recording(open_source("local/src", str(recording)))
    desk = Desk(tmp_path / "seen.yaml", "local/src", opened.lengths, opened.recorded, 0.05)
    return Review(opened, desk, "local/src", str(recording))


@pytest.fixture
def visit(browser: Any, review: Review) -> Iterator[Callable[..., Any]]:
    """Open the page; fails the test if the page's code fails or the browser refuses a part of it."""
    contexts, problems = [], []

    def open_page(**options: Any) -> Any:
        contexts.append(browser.new_context(**{"viewport": DESK, **options}))
        page = contexts[-1].new_page()
        page.set_default_timeout(WAIT_MS)
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on("console", lambda line: problems.append(line.text) if "Content Security" in line.text else None)
        page.goto(server.url)
        page.wait_for_selector("body[data-ready=true]")
        return page

    with PageServer(lambda token: make_app(review, token), "review page") as server:
        yield open_page
        for context in contexts:
            context.close()
    assert problems == []


def until(what: Callable[[], Any]) -> None:
    deadline = time.monotonic() + WAIT_MS / 1000
    while not what():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def steps(review: Review) -> list[dict[str, Any]]:
    """Steps of the recipe on disk but the filter; none where nothing was decided."""
    if not review.desk.recipe.exists():
        return []
    content = yaml.safe_load(review.desk.recipe.read_text()) or {}
    return [step for step in content.get("steps", []) if "filter" not in step]


@pytest.mark.parametrize("by", ["clicks", "keys"])
def test_labels_and_drops(visit: Callable[..., Any], review: Review, by: str) -> None:
    page = visit()

    def press(key: str, selector: str) -> None:
        page.locator(selector).click() if by == "clicks" else page.keyboard.press(key)

    press("s", '[data-label="success"]')
    until(lambda: review.desk.decided.of(0).success is True)
    press("n", "#next")
    page.wait_for_selector('#episodes li:nth-child(2) [aria-current="true"]')
    press("f", '[data-label="failure"]')
    until(lambda: review.desk.decided.of(1).success is False)
    press("n", "#next")
    page.wait_for_selector('#episodes li:nth-child(3) [aria-current="true"]')
    press("d", '[data-label="drop"]')
    until(lambda: review.desk.decided.of(2).drop)
    assert steps(review) == [{"drop": {"episodes": [2], "reason": "seen in review"}}, {"label": {"failed": [1]}}]
    until(lambda: "2 of 3 episodes" in page.locator("#overview").inner_text())
    press("u", "#undo")
    until(lambda: not review.desk.decided.of(2).drop)
    press("p", "#previous")
    page.wait_for_selector('#episodes li:nth-child(2) [aria-current="true"]')
    assert page.locator('[data-label="failure"]').get_attribute("aria-pressed") == "true"


def test_ends_are_set_at_the_picture_that_is_seen_and_by_the_handles(visit: Callable[..., Any], review: Review) -> None:
    page = visit()
    for _ in range(3):
        page.keyboard.press("ArrowRight")
    assert page.locator("#place").inner_text().startswith("step 3 of 20")
    page.keyboard.press("[")
    until(lambda: review.desk.decided.of(0).head == 3)
    box = page.locator("#track").bounding_box()
    handle = page.locator("#stop").bounding_box()
    page.mouse.move(handle["x"] + handle["width"] / 2, handle["y"] + 100)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] * 15.5 / LENGTHS[0], box["y"] + 100, steps=5)
    page.mouse.up()
    until(lambda: review.desk.decided.of(0).tail == LENGTHS[0] - 16)
    assert steps(review) == [{"trim": {"cuts": {0: [3, 4]}}}]


def test_the_threshold_shows_at_once_what_goes(visit: Callable[..., Any], review: Review) -> None:
    page = visit()
    marks = page.locator("#marks .gone")
    until(lambda: marks.count() > 0)
    before = marks.count()
    page.locator("#threshold").evaluate("slider => { slider.value = 1000; slider.dispatchEvent(new Event('input')); }")
    until(lambda: marks.count() != before)
    assert review.desk.decided.threshold == 0.05  # nothing is decided while it moves
    page.locator("#threshold").evaluate("slider => slider.dispatchEvent(new Event('change'))")
    until(lambda: review.desk.decided.threshold != 0.05)
    page.locator("#own-on").check()
    until(lambda: review.desk.decided.of(0).threshold is not None)
    page.locator("#own").evaluate("slider => { slider.value = 0; slider.dispatchEvent(new Event('change')); }")
    until(lambda: review.desk.decided.of(0).threshold == 0)
    until(lambda: marks.count() == 0)
    page.locator("#pauses-on").uncheck()
    until(lambda: review.desk.decided.threshold is None)


def test_a_film_plays_to_its_end_without_what_goes(visit: Callable[..., Any], review: Review) -> None:
    page = visit()
    until(lambda: page.locator("#films video").evaluate("film => film.readyState") >= 2)
    last = max(f for f in range(LENGTHS[0]))
    page.keyboard.press("Space")
    until(lambda: page.locator("#place").inner_text().startswith(f"step {last} "))
    until(lambda: page.locator("#play span").inner_text() == "Play")
    shown = page.locator("#films video").evaluate("film => film.currentTime")
    assert abs(shown - (last + 0.5) / 30) < 0.3


def test_a_task_is_typed_without_its_letters_being_taken_for_keys(visit: Callable[..., Any], review: Review) -> None:
    page = visit()
    page.locator("#task").fill("")
    page.locator("#task").type("find sugar, drop [nuts]")
    page.keyboard.press("Enter")
    until(lambda: review.desk.decided.of(0).task == "find sugar, drop [nuts]")
    assert steps(review) == [{"task": {"episode_tasks": {0: "find sugar, drop [nuts]"}}}]
    page.locator("#task-all").click()
    until(lambda: len(review.desk.decided.episodes) == 3)


def test_what_is_refused_is_said_on_the_page(visit: Callable[..., Any], review: Review) -> None:
    page = visit()
    page.locator("#new-root").fill(str(review.recording.source.root))
    page.locator("#run button").click()
    page.locator("#refused").wait_for()
    assert "exists already" in page.locator("#refused").inner_text()


@pytest.mark.parametrize("size", [DESK, {"width": 1366, "height": 650}, PHONE])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_page_fits_the_screen(visit: Callable[..., Any], size: dict[str, int], scheme: str) -> None:
    page = visit(viewport=size, color_scheme=scheme)
    assert page.evaluate("document.documentElement.scrollWidth") <= size["width"]
    for name in ("[data-label=success]", "[data-label=failure]", "[data-label=drop]", "#next"):
        box = page.locator(name).bounding_box()
        assert box["y"] >= 0
        assert box["y"] + box["height"] <= size["height"]
        assert box["height"] >= 44


def test_pictures_that_are_no_film_are_shown_one_by_one(browser: Any, tmp_path: Path) -> None:
    root = write_columns(tmp_path / "src", [{STATE: moving(12), ACTION: moving(12), TOP: grey(12)}], stills=True)
    opened = Recording(open_source("local/src", str(root)))
    desk = Desk(tmp_path / "seen.yaml", "local/src", opened.lengths, opened.recorded, None)
    review = Review(opened, desk, "local/src", str(root))
    with PageServer(lambda token: make_app(review, token), "review page") as server:
        page = browser.new_page(viewport=DESK)
        page.goto(server.url)
        page.wait_for_selector("body[data-ready=true]")
        shown = page.locator("#films img")
        until(lambda: shown.evaluate("picture => picture.naturalWidth") == 48)
        page.keyboard.press("ArrowRight")
        until(lambda: "first=1&" in shown.get_attribute("src"))
        page.keyboard.press("Space")
        until(lambda: page.locator("#place").inner_text().startswith("step 11 "))
        page.close()
