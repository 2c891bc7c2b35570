"""What the page shows, and who may steer: without a web server, on clocks that the tests turn."""

import contextlib
import json
import math
import threading

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cqn_train.operator.board import Board
from cqn_train.operator.control import LEFT_S, Control, ViewingOnlyError
from cqn_train.operator.session import Event, Label, RefusedError, Session, State

from ..driven_clock import DrivenClock


def picture(value: int = 0, height: int = 48, width: int = 64) -> np.ndarray:
    return np.full((height, width, 3), value, np.uint8)


@pytest.fixture
def clock() -> DrivenClock:
    return DrivenClock()


@pytest.fixture
def board(clock: DrivenClock) -> Board:
    return Board(Session(), clock=clock)


def test_a_snapshot_of_nothing_is_plain_json(board: Board) -> None:
    shown = board.snapshot()
    assert json.loads(json.dumps(shown, allow_nan=False)) == shown
    assert (shown["progress"], shown["cameras"], shown["finished"]) == (None, [], [])


odd = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5), st.binary(max_size=3),
    st.just(np.float32("nan")), st.just(np.int64(7)), st.just([1, 2]), st.just(object()), st.just(10**400),
)  # fmt: skip


@given(st.dictionaries(st.text(max_size=8), odd, max_size=4), odd, odd, st.text())
def test_odd_values_neither_raise_nor_break_the_json(values: dict, one: object, two: object, text: str) -> None:
    board = Board(Session())
    board.begin_episode(0)
    board.show(values)
    board.health(**values)
    board.log({f"episodes/{name}": value for name, value in values.items()} | {"episodes/episode": one})
    board.log({"evaluations/success_rate": one, "evaluations/episodes": two, "": two})
    board.phase(text, one, two)
    board.advance(two, text)
    board.message(text)
    board.end_episode(0, one, two)
    json.dumps(board.snapshot(), allow_nan=False)


def test_pictures_are_copied_and_encoded_once_when_asked(board: Board, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    encode = cv2.imencode
    monkeypatch.setattr(cv2, "imencode", lambda *args: calls.append(1) or encode(*args))
    shown = np.zeros((48, 64, 3), np.uint8)
    shown[...] = (200, 40, 10)
    board.show({"front": shown})
    shown[...] = 0
    assert calls == []
    data = board.jpeg("front")
    assert board.jpeg("front") is data
    assert len(calls) == 1
    decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert np.abs(decoded.astype(int).mean((0, 1)) - (200, 40, 10)).max() < 5  # red stays red
    assert board.jpeg("nowhere") is None


def test_what_is_no_picture_is_named_once(board: Board) -> None:
    for _ in range(3):
        board.show({"front": np.zeros((3, 64, 64), np.float32), "good": picture()})
    assert [line["text"] for line in board.snapshot()["log"]] == [
        "Camera front is not shown: expected uint8 [H, W, 3], found float32 (3, 64, 64)."
    ]
    assert board.snapshot()["cameras"] == ["good"]


def test_a_picture_that_is_not_renewed_is_seen_to_age(board: Board, clock: DrivenClock) -> None:
    board.show({"front": picture()})
    clock.now += 4
    assert board.snapshot()["camera_age_s"] == {"front": 4.0}


def film(board: Board, clock: DrivenClock, number: int, seconds: float, hz: float = 20) -> None:
    board.session.learning("")
    if board.session.state is State.RESETTING:
        board.session.apply(Event.READY)
    board.session.apply(Event.START)
    board.begin_episode(number)
    for step in range(round(seconds * hz)):
        board.show({"front": picture(step % 256)})
        clock.now += 1 / hz
    board.session.apply(Event.SUCCESS)
    board.end_episode(number, round(seconds * hz), seconds)


def test_a_film_has_the_rate_and_the_times_of_what_happened(board: Board, clock: DrivenClock) -> None:
    film(board, clock, 0, seconds=4)
    times = board.film_times(0, "front")
    assert times == pytest.approx(np.arange(20) / 5, abs=0.06)
    assert board.film_jpeg(0, "front", 19)
    assert board.film_jpeg(0, "front", 20) is None
    assert board.film_jpeg(0, "front", -1) is None
    assert board.film_times(0, "wrist") is board.film_times(1, "front") is None


def test_a_pause_is_left_out_of_the_film(board: Board, clock: DrivenClock) -> None:
    board.session.apply(Event.START)
    board.begin_episode(0)
    board.show({"front": picture()})
    board.session.apply(Event.PAUSE)
    for _ in range(20):
        clock.now += 3
        board.show({"front": picture()})
    board.session.apply(Event.RESUME)
    board.show({"front": picture()})
    assert board.film_times(0, "front") == [0.0, 0.2]


def test_only_the_last_films_are_kept_and_none_between_episodes(board: Board, clock: DrivenClock) -> None:
    for number in range(8):
        film(board, clock, number, seconds=0.5)
        board.show({"front": picture()})
    films = [entry["film"] for entry in board.snapshot()["finished"]]
    assert films == [False] * 2 + [True] * 6  # the last one and the five before it
    assert len(board.film_times(7, "front")) == 3


def test_a_long_film_of_large_pictures_stays_small(clock: DrivenClock) -> None:
    board = Board(Session(), clock=clock)
    board._films._film_bytes = 40 * picture(0, 240, 320).nbytes
    board.session.apply(Event.START)
    board.begin_episode(0)
    for _ in range(600):
        board.show({"front": picture(0, 480, 640)})
        clock.now += 0.2
    times = board.film_times(0, "front")
    assert 20 <= len(times) <= 40
    assert times[-1] == pytest.approx(120, abs=8)  # thinner, but of the whole episode
    assert np.diff(times).max() < 10


def test_progress_and_time_left(board: Board, clock: DrivenClock) -> None:
    board.phase("updates", 400, 100)
    clock.now += 10
    board.advance(200, "loss 0.1")
    progress = board.snapshot()["progress"]
    assert progress == {"name": "updates", "total": 400, "done": 200, "note": "loss 0.1", "elapsed_s": 10, "eta_s": 20}
    board.advance(500, "")
    assert board.snapshot()["progress"]["eta_s"] is None


def test_the_log_keeps_the_last_lines(board: Board) -> None:
    for number in range(300):
        board.message(f"line {number}")
    texts = [line["text"] for line in board.snapshot()["log"]]
    assert (len(texts), texts[0], texts[-1]) == (200, "line 100", "line 299")


def test_learning_curve(board: Board) -> None:
    for number, success in enumerate([0, 1, 1, 1, 1, 1, 0]):
        board.log({"episodes/episode": number, "episodes/success": success, "episodes/env_steps": 10 * number})
    board.log({"evaluations/episodes": 5, "evaluations/success_rate": 0.6, "evaluations/ci_low": math.nan})
    curve = board.snapshot()["curve"]
    assert curve["episodes"][:2] == [[0, 0, 0.0], [1, 1, 0.5]]
    assert curve["episodes"][5:] == [[5, 1, 1.0], [6, 0, 0.8]]
    assert curve["evaluations"] == [
        {"episodes": 5, "success_rate": 0.6, "ci_low": None, "ci_high": None, "n": None}
    ]  # fmt: skip
    # A person's word beats the row; a discarded episode and an evaluation are no points.
    board.session.labels |= {6: Label.SUCCESS, 5: Label.DISCARD, -1: Label.SUCCESS}
    assert board.snapshot()["curve"]["episodes"][4:] == [[4, 1, 0.8], [6, 1, 1.0]]


def test_timers(board: Board, clock: DrivenClock) -> None:
    clock.now += 5
    board.session.apply(Event.START)
    board.begin_episode(0)
    clock.now += 2
    board.session.apply(Event.PAUSE)
    clock.now += 3
    timers = board.snapshot()["timers"]
    assert timers == {"state_s": 3, "busy_s": None, "episode_s": 5, "run_s": 10}
    board.session.apply(Event.SUCCESS)
    board.end_episode(0, 20, 4.5)
    board.session.learning("updates")
    clock.now += 7
    timers = board.snapshot()["timers"]
    assert (timers["state_s"], timers["busy_s"], timers["episode_s"]) == (7, 7, 4.5)


def test_finished_episodes_come_in_the_order_of_their_ends(board: Board, clock: DrivenClock) -> None:
    film(board, clock, 0, 0.5)
    board.session.expect(None)
    film(board, clock, -1, 0.5)
    shown = [(entry["episode"], entry["evaluation"], entry["label"]) for entry in board.snapshot()["finished"]]
    assert shown == [(0, False, "success"), (-1, True, "success")]


def test_the_episode_that_waits_for_its_label_can_be_looked_at(board: Board) -> None:
    board.session.apply(Event.START)
    board.begin_episode(0)
    board.show({"front": picture()})
    board.session.apply(Event.TIME_UP)
    entry = board.snapshot()["finished"][-1]
    assert (entry["episode"], entry["label"], entry["film"], entry["cameras"]) == (0, None, True, ["front"])


def test_listeners_hear_of_changes_and_cannot_do_harm(board: Board) -> None:
    heard: list[str] = []
    session = Session(on_change=lambda s: heard.append(f"before {s.state}"))
    board = Board(session)
    board.listen(lambda: 1 / 0)
    forget = board.listen(lambda: heard.append("listener"))
    session.apply(Event.START)
    forget()
    session.apply(Event.PAUSE)
    assert heard == ["before running", "listener", "before paused"]


def test_many_threads(board: Board) -> None:
    problems = []

    def run(work: object) -> None:
        try:
            for _ in range(150):
                work()
        except Exception as error:
            problems.append(error)

    def steer() -> None:
        for event in Event:
            if event not in (Event.STOP, Event.FAULT):
                with contextlib.suppress(RefusedError):
                    board.session.apply(event)
        board.session.learning("")

    def train() -> None:
        board.begin_episode(board.session.episode)
        board.show({"front": picture()})
        board.advance(1, "")
        board.end_episode(board.session.episode, 1, 1.0)

    works = (steer, train, train, board.snapshot, lambda: board.jpeg("front"))
    threads = [threading.Thread(target=run, args=(work,)) for work in works]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
        assert not thread.is_alive()
    assert problems == []


# --- Who may steer.


@pytest.fixture
def control(clock: DrivenClock) -> Control:
    return Control(Session(), 10.0, clock=clock)


def running(control: Control) -> Session:
    control.apply("ann", Event.START)
    return control._session


def test_the_first_is_the_operator_and_others_only_pause_and_stop(control: Control) -> None:
    session = running(control)
    with pytest.raises(ViewingOnlyError, match="Take control"):
        control.apply("bob", Event.SUCCESS)
    with pytest.raises(ViewingOnlyError):
        control.apply(None, Event.SUCCESS)
    with pytest.raises(ViewingOnlyError):
        control.correct("bob", 0, Label.FAILURE)
    assert session.state is State.RUNNING
    control.take("bob")
    assert control.snapshot("bob")["you"] == "operator"
    assert control.snapshot("ann")["you"] == "viewer"
    control.apply("bob", Event.PAUSE)
    with pytest.raises(ViewingOnlyError):
        control.apply("ann", Event.RESUME)
    control.apply("ann", Event.STOP)
    assert session.state is State.STOPPED


@pytest.mark.parametrize("client", [None, "ann", "bob"])
def test_everybody_may_pause_and_only_the_operator_goes_on(control: Control, client: str | None) -> None:
    session = running(control)
    assert control.apply(client, Event.PAUSE) is State.PAUSED
    if client != "ann":
        with pytest.raises(ViewingOnlyError):
            control.apply(client, Event.RESUME)
    assert session.state is State.PAUSED


@pytest.mark.parametrize("client", [None, "ann", "bob"])
def test_everybody_may_stop(control: Control, client: str | None) -> None:
    session = running(control)
    control.apply(client, Event.STOP)
    control.apply(client, Event.STOP)
    assert session.state is State.STOPPED


@pytest.mark.parametrize("event", [Event.FAULT, Event.ABSENT, Event.TIME_UP, Event.RECOVERED])
def test_what_happens_by_itself_is_nobodys(control: Control, event: Event) -> None:
    session = running(control)
    with pytest.raises(RefusedError, match="by itself"):
        control.apply("ann", event)
    assert session.state is State.RUNNING


@pytest.mark.parametrize("teach", [False, True])
def test_an_arm_that_moves_pauses_when_its_operator_is_gone(control: Control, clock: DrivenClock, teach: bool) -> None:
    session = running(control)
    if teach:
        control.apply("ann", Event.TAKE_OVER)
    clock.now += 9
    assert not control.check()
    control.seen("ann")
    clock.now += 9
    control.seen("bob")  # another's sign of life is not the operator's
    assert not control.check()
    clock.now += 2
    assert control.check()
    assert session.state is State.PAUSED
    assert not control.check()


def test_a_closed_page_pauses_sooner_and_one_that_is_loaded_anew_does_not(control: Control, clock: DrivenClock) -> None:
    session = running(control)
    control.opened("ann")
    control.opened("ann")
    control.closed("ann")
    clock.now += LEFT_S + 0.1
    assert not control.check()  # one of two is still open
    control.closed("ann")
    clock.now += LEFT_S - 0.1
    control.opened("ann")
    clock.now += 1
    assert not control.check()
    control.closed("ann")
    clock.now += LEFT_S + 0.1
    assert control.check()
    assert session.state is State.PAUSED


@pytest.mark.parametrize("state", [State.WAITING, State.RESETTING])
def test_an_arm_on_its_way_home_is_held_when_its_operator_is_gone(
    control: Control, clock: DrivenClock, state: State
) -> None:
    session = running(control)
    control.apply("ann", Event.SUCCESS)
    session.learning("")
    if state is State.WAITING:
        control.apply("ann", Event.READY)
    session.note_homing(True)
    clock.now += 9
    assert not control.check()
    clock.now += 2
    assert control.check()
    assert (session.state, session.homing) == (state, False)
    assert not control.check()


def test_nobody_at_all_is_absent(clock: DrivenClock) -> None:
    session = Session()
    session.apply(Event.START)
    assert Control(session, 10.0, clock=clock).check()
    assert session.state is State.PAUSED


@pytest.mark.parametrize("state", [State.WAITING, State.PAUSED, State.LABELLING, State.RESETTING, State.STOPPED])
def test_an_arm_that_rests_needs_nobody(clock: DrivenClock, state: State) -> None:
    session = Session(state=state)
    assert not Control(session, 10.0, clock=clock).check()
    assert session.state is state
