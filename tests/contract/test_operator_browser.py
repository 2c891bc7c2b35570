"""The operator's page in a browser: a person's clicks and keys, and what they see."""

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from cqn_train.operator.board import Board
from cqn_train.operator.page.server import OperatorServer
from cqn_train.operator.session import Event, Label, Session, State

from .browsing import IN_A_BROWSER, WAIT_MS, browser_fixture  # noqa: F401  # skips where there is no browser

pytestmark = IN_A_BROWSER
PHONE = {"width": 375, "height": 812}
NAMES = {
    "start": "Start", "pause": "Pause", "resume": "Resume", "success": "Success", "failure": "Failure",
    "discard": "Discard", "take_over": "Take over", "hand_back": "Hand back", "home": "Home", "free": "By hand",
    "ready": "Ready", "stop": "Stop run",
}  # fmt: skip


@pytest.fixture
def board() -> Iterator[Board]:
    """A board that a robot keeps showing pictures on."""
    board, over = Board(Session()), threading.Event()

    def show() -> None:
        value = 0
        while not over.wait(0.05):
            value = (value + 3) % 256
            board.show({name: np.full((48, 64, 3), value, np.uint8) for name in ("front", "wrist")})

    thread = threading.Thread(target=show)
    thread.start()
    yield board
    over.set()
    thread.join()


@pytest.fixture
def server(board: Board) -> Iterator[OperatorServer]:
    with OperatorServer(board) as server:
        yield server


@pytest.fixture
def visit(browser: Any) -> Iterator[Callable[..., Any]]:
    """Open a page as somebody of their own; fails the test if the page's code fails."""
    contexts, problems = [], []

    def open_page(url: str, **options: Any) -> Any:
        contexts.append(browser.new_context(**options))
        page = contexts[-1].new_page()
        page.set_default_timeout(WAIT_MS)
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.goto(url)
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert problems == []


def button(page: Any, event: str) -> Any:
    return page.locator(f'#controls button[data-event="{event}"]')


def until(page: Any, expression: str) -> None:
    """Wait for it; Playwright's own way would need `eval`, which the page forbids."""
    deadline = time.monotonic() + WAIT_MS / 1000
    while not page.evaluate(expression):
        assert time.monotonic() < deadline, expression
        page.wait_for_timeout(20)


def sees(page: Any, state: State) -> None:
    page.wait_for_selector(f'body.online[data-state="{state}"]', state="attached")


def offers(page: Any, board: Board) -> None:
    """What can be pressed is what has its place, under its name."""
    shown = page.eval_on_selector_all("#controls button:not(:disabled)", "all => all.map(b => b.dataset.event)")
    assert sorted(shown) == sorted(board.session.allowed())
    for event in shown:
        assert button(page, event).locator("span").inner_text() == NAMES[event]


SESSION = [
    ("start", "Space", State.RUNNING), ("pause", "Space", State.PAUSED), ("resume", "Space", State.RUNNING),
    ("take_over", "t", State.TEACHING), ("hand_back", "t", State.RUNNING), ("success", "s", State.RESETTING),
    ("home", "h", State.RESETTING), ("free", "m", State.RESETTING), ("ready", "R", State.WAITING),
    ("start", "Space", State.RUNNING), ("failure", "f", State.RESETTING), ("ready", "r", State.WAITING),
    ("start", "Space", State.RUNNING), ("discard", "d", State.RESETTING), ("stop", "Escape", State.STOPPED),
]  # fmt: skip


@pytest.mark.parametrize("by", ["clicks", "keys"])
def test_a_whole_session(server: OperatorServer, board: Board, visit: Callable[..., Any], by: str) -> None:
    page = visit(server.url)
    sees(page, State.WAITING)
    assert page.locator("h1").inner_text() == "Ready"
    for event, key, state in SESSION:
        page.wait_for_selector(f'#controls button[data-event="{event}"]:not(:disabled)')
        offers(page, board)
        if by == "clicks":
            button(page, event).click()
        else:
            page.keyboard.press(key)
        sees(page, state)
        board.session.learning("")  # what was learned meanwhile
        if event == "free":
            until(page, "document.querySelector('#state-hint').textContent.includes('moved by hand')")
    assert board.session.labels == {0: Label.SUCCESS, 1: Label.FAILURE, 2: Label.DISCARD}
    assert page.locator("#controls button:not(:disabled)").count() == 0


def test_keys_that_are_held_or_typed_or_belong_to_the_browser_do_nothing(
    server: OperatorServer, board: Board, visit: Callable[..., Any]
) -> None:
    page = visit(server.url)
    sees(page, State.WAITING)
    page.evaluate("document.body.append(Object.assign(document.createElement('input'), {id: 'typing'}))")
    page.focus("#typing")
    page.keyboard.press("Space")
    page.keyboard.press("s")
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press("Control+s")
    for _ in range(5):  # the first is a press, the others are repeats of a key that is down
        page.keyboard.down("Space")
    page.keyboard.up("Space")
    sees(page, State.RUNNING)
    page.wait_for_timeout(300)
    assert board.session.state is State.RUNNING  # and letting go of Space did not press the button in focus


OPEN_FILM = "document.querySelector('#player').hidden = false; "
FOCUS = {
    "nothing": "document.activeElement.blur()",
    "the film's slider": f"{OPEN_FILM}document.querySelector('#film-seek').focus()",
    "the film's button": f"{OPEN_FILM}document.querySelector('#film-play').focus()",
    "the log": "document.querySelector('#log').focus()",
    "a field": "document.body.append(Object.assign(document.createElement('input'), {id: 'f'}));"
    " document.querySelector('#f').focus()",
}  # fmt: skip


@pytest.mark.parametrize("focus", FOCUS)
@pytest.mark.parametrize("held", ["", "Control+", "Alt+", "Meta+", "Shift+"])
def test_stop_and_pause_come_through_whatever_has_the_focus(
    server: OperatorServer, board: Board, visit: Callable[..., Any], focus: str, held: str
) -> None:
    page = visit(server.url)
    sees(page, State.WAITING)
    board.session.apply(Event.START)
    sees(page, State.RUNNING)
    page.evaluate(FOCUS[focus])
    page.keyboard.press(f"{held}Space")
    sees(page, State.PAUSED)
    page.evaluate(FOCUS[focus])
    page.keyboard.press(f"{held}Escape")
    sees(page, State.STOPPED)


def test_an_arm_on_its_way_home_is_paused_by_the_same_key(
    server: OperatorServer, board: Board, visit: Callable[..., Any]
) -> None:
    page = visit(server.url)
    sees(page, State.WAITING)
    board.session.note_homing(True)
    page.wait_for_selector('#controls button[data-event="pause"]:not(:disabled)')
    page.keyboard.press("Space")
    page.wait_for_selector('#controls button[data-event="start"]:not(:disabled)')
    assert (board.session.homing, board.session.state) == (False, State.WAITING)


SCREENS = [{"width": width, "height": height} for width, height in ((1366, 650), (1280, 800), (900, 500), (821, 600))]


@pytest.mark.parametrize("screen", SCREENS, ids=lambda screen: f"{screen['width']}x{screen['height']}")
def test_stop_and_pause_are_in_sight_on_every_screen(
    server: OperatorServer, board: Board, visit: Callable[..., Any], screen: dict[str, int]
) -> None:
    board.show({f"camera_{i}": np.full((480, 640, 3), 60 * i, np.uint8) for i in range(4)})
    page = visit(server.url, viewport=screen)
    board.session.apply(Event.START)
    sees(page, State.RUNNING)
    until(page, "document.querySelectorAll('#cameras img[src]').length >= 4")
    for top in (0, 100_000):
        page.evaluate(f"window.scrollTo(0, {top})")
        for event in ("pause", "stop"):
            box = button(page, event).bounding_box()
            assert box["y"] >= 0
            assert box["y"] + box["height"] <= screen["height"]
            assert box["x"] + box["width"] <= screen["width"]
    assert page.evaluate("document.documentElement.scrollWidth") <= screen["width"]
    last = page.locator("footer").bounding_box()  # scrolled to the end, the bar hides nothing
    assert last["y"] + last["height"] <= page.locator("#controls").bounding_box()["y"] + 1


def test_live_pictures_change_and_one_that_is_old_says_so(
    server: OperatorServer, board: Board, visit: Callable[..., Any]
) -> None:
    page = visit(server.url)
    until(page, "document.querySelectorAll('#cameras img[src]').length === 2")
    first = page.get_attribute("#cameras img", "src")
    until(page, f"document.querySelector('#cameras img').src !== '{first}'")
    board.show({"broken": np.zeros((8, 8, 3), np.uint8)})
    page.wait_for_selector("figure.stale figcaption:text('broken')")
    assert page.locator("figure.stale").count() == 1


def test_the_last_episode_is_played_and_labelled_otherwise(
    server: OperatorServer, board: Board, visit: Callable[..., Any]
) -> None:
    page = visit(server.url)
    sees(page, State.WAITING)
    board.session.apply(Event.START)
    board.begin_episode(0)
    page.wait_for_timeout(1200)
    board.session.apply(Event.TIME_UP)
    until(page, "document.querySelectorAll('#film-pictures img[src]').length === 2")  # by itself
    assert board.film_times(0, "front")[-1] == pytest.approx(1.1, abs=0.6)
    button(page, "success").click()
    sees(page, State.RESETTING)
    board.end_episode(0, 12, 1.2)
    page.get_by_role("button", name="Label episode 0 as failure").click()
    page.wait_for_selector('#episodes button[data-label="failure"][aria-pressed="true"]')
    assert board.session.labels == {0: Label.FAILURE}
    page.get_by_role("button", name="Play the film of episode 0").click()
    until(page, "document.querySelector('#film-play').textContent === 'Pause'")
    until(page, "document.querySelector('#film-play').textContent === 'Play'")  # it came to its end
    assert (
        page.locator("#film-time").inner_text().split(" ")[0] == page.locator("#film-time").inner_text().split(" ")[2]
    )


def test_curve_progress_health_and_log(server: OperatorServer, board: Board, visit: Callable[..., Any]) -> None:
    page = visit(server.url)
    sees(page, State.WAITING)
    for number in range(7):
        board.log({"episodes/episode": number, "episodes/success": int(number > 2)})
    board.log({"evaluations/episodes": 6, "evaluations/success_rate": 0.5})
    board.health(rate_hz=4.98, worst_ms=915.15, late=2, gripper="<b>closed</b>")
    board.message("a <i>line</i>")
    board.session.learning("updates after episode 6")
    board.phase("updates", 400, 0)
    board.advance(100, "")
    until(page, "document.querySelectorAll('#curve circle').length === 7")
    assert page.locator("#curve rect").count() == page.locator("#curve polyline").count() == 1
    assert "Control rate\n5.0 Hz" in page.locator("#health").inner_text()
    assert "Longest step\n915 ms" in page.locator("#health").inner_text()
    assert "<b>closed</b>" in page.locator("#health").inner_text()  # a text, not a page
    assert "a <i>line</i>" in page.locator("#log").inner_text()
    assert "updates 100 of 400" in page.locator("#working-text").inner_text()
    assert button(page, "start").count() == 0
    assert "the next episode can start when it is done" in page.locator("#state-hint").inner_text()


def test_one_operator_and_viewers_who_stop_or_take_control(
    server: OperatorServer, board: Board, visit: Callable[..., Any]
) -> None:
    ann = visit(server.url)
    sees(ann, State.WAITING)
    bob = visit(server.url)
    sees(bob, State.WAITING)
    assert not ann.locator("#viewing").is_visible()
    bob.wait_for_selector("#viewing")
    assert bob.locator("#controls button:not(:disabled)").all_inner_texts() == ["Stop run\nEsc"]
    bob.keyboard.press("Space")
    bob.click("#take-control")
    ann.wait_for_selector("#viewing")
    assert board.session.state is State.WAITING
    bob.wait_for_selector("#viewing", state="hidden")
    bob.keyboard.press("Space")
    sees(ann, State.RUNNING)
    ann.keyboard.press("Escape")
    sees(bob, State.STOPPED)


def test_it_says_when_the_connection_is_gone_and_comes_back_by_itself(
    server: OperatorServer, board: Board, visit: Callable[..., Any]
) -> None:
    page = visit(server.url)
    sees(page, State.WAITING)
    server.close()
    page.wait_for_selector("#offline:not([hidden])")
    assert "No connection" in page.locator("#offline").inner_text()
    assert page.locator("h1").inner_text() == "Last known: Ready"
    assert page.locator("#controls button:not(:disabled)").all_inner_texts() == ["Stop run\nEsc"]
    with OperatorServer(board, port=server.port, token=server.token):
        sees(page, State.WAITING)
        page.wait_for_selector("#offline", state="hidden")
        page.keyboard.press("Space")
        sees(page, State.RUNNING)


def test_the_token_leaves_the_address_and_survives_a_reload(server: OperatorServer, visit: Callable[..., Any]) -> None:
    page = visit(server.url)
    sees(page, State.WAITING)
    assert server.token not in page.url
    page.reload()
    sees(page, State.WAITING)
    assert not page.locator("#viewing").is_visible()  # the same person as before


@pytest.mark.parametrize("query", ["?token=wrong-token", ""])
def test_a_wrong_token_shows_nothing(server: OperatorServer, visit: Callable[..., Any], query: str) -> None:
    page = visit(server.url.partition("?")[0] + query)
    page.wait_for_selector("body.denied", state="attached")
    assert "token is missing or wrong" in page.locator("#offline").inner_text()
    assert page.locator("#cameras img").count() == 0
    assert page.locator("#controls button:not(:disabled)").count() == 0


def test_nothing_is_loaded_from_elsewhere(server: OperatorServer, visit: Callable[..., Any]) -> None:
    asked = []
    page = visit("about:blank")
    page.on("request", lambda request: asked.append(request.url))
    page.goto(server.url)
    until(page, "document.querySelectorAll('#cameras img[src]').length === 2")
    home = server.url.partition("?")[0]
    assert [url for url in asked if not url.startswith((home, f"blob:{home}", "data:"))] == []
    assert [url for url in asked if "token=" in url and "?token=" not in url.removeprefix(home)[:7]] == []


@pytest.mark.parametrize("state", [State.RUNNING, State.LABELLING, State.FAULTED])
def test_on_a_phone_all_is_within_reach(
    server: OperatorServer, board: Board, visit: Callable[..., Any], state: State
) -> None:
    page = visit(server.url, viewport=PHONE, has_touch=True, is_mobile=True)
    sees(page, State.WAITING)
    board.session.apply(Event.START)
    if state is not State.RUNNING:
        board.session.apply(Event.FAULT if state is State.FAULTED else Event.TIME_UP, "Joint 3 does not answer.")
    sees(page, state)
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    for place in page.locator("#controls button").all():
        box = place.bounding_box()
        assert box["height"] >= 44
        assert box["width"] >= 44
        assert box["y"] > PHONE["height"] / 2
        assert box["y"] + box["height"] <= PHONE["height"]
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= PHONE["width"]
    cut = "all => all.filter(e => e.scrollWidth > e.clientWidth + 1).map(e => e.textContent)"
    assert page.eval_on_selector_all("#controls button, h1, #state-hint", cut) == []
    button(page, "stop").tap()
    sees(page, State.STOPPED)


READ = "h1, #state-hint, dt, dd, h2, button:not(:disabled) span, .fine-print, footer span, #log li"
CONTRAST = """(read) => {
  const rgb = (text) => text.match(/[\\d.]+/g).map(Number);
  const linear = (v) => v / 255 <= 0.04045 ? v / 255 / 12.92 : ((v / 255 + 0.055) / 1.055) ** 2.4;
  const light = ([r, g, b]) => 0.2126 * linear(r) + 0.7152 * linear(g) + 0.0722 * linear(b);
  const behind = (e) => {
    const own = e ? rgb(getComputedStyle(e).backgroundColor) : [255, 255, 255];
    return own[3] === 0 ? behind(e.parentElement) : own;
  };
  return [...document.querySelectorAll(read)].filter((e) => e.textContent.trim() && e.offsetParent).map((e) => {
    const [a, b] = [light(rgb(getComputedStyle(e).color)), light(behind(e))].sort((x, y) => y - x);
    return [(a + 0.05) / (b + 0.05), e.textContent];
  }).filter(([ratio]) => ratio < 4.5);
}"""


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_everything_can_be_read_in_every_state(
    server: OperatorServer, board: Board, visit: Callable[..., Any], scheme: str
) -> None:
    board.health(rate_hz=5.0)
    board.message("a line")
    page = visit(server.url, color_scheme=scheme, reduced_motion="reduce")
    for state in State:
        board.session.state = state
        board.session.learning("")
        sees(page, state)
        assert page.evaluate(CONTRAST, READ) == [], state
    assert page.get_attribute(".state-words", "aria-live") == "assertive"
