"""The session: every event in every state, and what holds whatever happens."""

import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cqn_train import interfaces
from cqn_train.operator.session import TRANSITIONS, Event, Label, RefusedError, Session, State

# What a person would expect, written down on its own: state -> event -> next state; the rest is refused.
EXPECTED = {
    "waiting": {"start": "running", "home": "waiting", "free": "waiting"},
    "running": {
        "pause": "paused", "absent": "paused", "take_over": "teaching", "time_up": "labelling", "success": "resetting",
        "failure": "resetting", "discard": "resetting",
    },
    "paused": {
        "resume": "running", "take_over": "teaching", "success": "resetting", "failure": "resetting",
        "discard": "resetting",
    },
    "teaching": {
        "hand_back": "running", "pause": "paused", "absent": "paused", "time_up": "labelling", "success": "resetting",
        "failure": "resetting", "discard": "resetting",
    },
    "labelling": {"success": "resetting", "failure": "resetting", "discard": "resetting"},
    "resetting": {"ready": "waiting", "home": "resetting", "free": "resetting"},
    "faulted": {"recovered": "resetting", "free": "faulted"},
    "stopped": {},
}  # fmt: skip
PATHS: dict[State, list[Event]] = {
    State.WAITING: [],
    State.RUNNING: [Event.START],
    State.PAUSED: [Event.START, Event.PAUSE],
    State.TEACHING: [Event.START, Event.TAKE_OVER],
    State.LABELLING: [Event.START, Event.TIME_UP],
    State.RESETTING: [Event.START, Event.SUCCESS],
    State.FAULTED: [Event.FAULT],
    State.STOPPED: [Event.STOP],
}
events = st.sampled_from(list(Event))


def session(state: State) -> Session:
    made = Session()
    for event in PATHS[state]:
        made.apply(event)
    assert made.state is state
    return made


@pytest.mark.parametrize("state", State)
@pytest.mark.parametrize("event", Event)
def test_every_event_in_every_state(state: State, event: Event) -> None:
    made = session(state)
    expected = dict(EXPECTED[state])
    expected["stop"] = "stopped"
    if state is not State.STOPPED:
        expected["fault"] = "faulted"
    before = made.snapshot()
    if event in expected:
        assert made.apply(event) == expected[event]
    else:
        with pytest.raises(RefusedError, match=f"'{event}' has no place while {state}"):
            made.apply(event)
        assert made.snapshot() == before


def test_every_state_is_in_the_table() -> None:
    assert set(TRANSITIONS) == set(State) == set(PATHS)


@given(st.lists(events, max_size=40))
def test_whatever_happens(sequence: list[Event]) -> None:
    made, changes = Session(), []
    made.on_change = lambda s: changes.append(s.state)
    started, applied, stopped = 0, 0, False
    for event in sequence:
        before, labels = made.state, dict(made.labels)
        try:
            made.apply(event)
        except RefusedError:
            assert made.state is before
            continue
        applied += 1
        if event in ("success", "failure", "discard"):
            assert made.busy
            made.learning("")  # the learner is quick
            applied += 1
        started += event is Event.START
        stopped = stopped or event is Event.STOP
        assert made.episode == started - 1
        assert (made.state is State.STOPPED) == stopped  # nothing leaves it, and only stop enters
        # A label is given once, by a person, to the episode that ran, and never changes by itself.
        assert labels.items() <= made.labels.items()
        assert len(made.labels) - len(labels) == (event in ("success", "failure", "discard"))
        # Every episode before the present one has its label.
        assert set(made.labels) >= set(range(made.episode))
    assert len(changes) == applied


def test_an_episode_in_which_the_robot_failed_is_neither_lost_nor_labelled_by_itself() -> None:
    for path in (PATHS[State.RUNNING], PATHS[State.PAUSED], PATHS[State.TEACHING], PATHS[State.LABELLING]):
        made = Session()
        for event in path:
            made.apply(event)
        made.apply(Event.FAULT, "unplugged")
        made.apply(Event.FAULT)  # and again while it is looked after
        assert made.fault == "unplugged"
        assert made.apply(Event.RECOVERED) is State.LABELLING
        assert made.fault == ""
        assert made.labels == {}
        made.apply(Event.DISCARD)
        assert made.labels == {0: Label.DISCARD}


def test_between_episodes_a_fault_asks_for_no_label() -> None:
    made = session(State.RESETTING)
    made.apply(Event.FAULT)
    assert made.apply(Event.RECOVERED) is State.RESETTING


def test_correcting_a_label() -> None:
    made = session(State.RESETTING)
    with pytest.raises(RefusedError, match="finished episodes are 0 to 0"):
        made.correct(3, Label.FAILURE)
    made.correct(0, Label.SUCCESS)  # as it is
    assert made.take_corrected() == {}
    made.correct(0, Label.FAILURE)
    made.correct(0, Label.DISCARD)
    assert made.take_corrected() == {0: Label.DISCARD}
    assert made.take_corrected() == {}
    assert made.snapshot()["labels"] == {"0": "discard"}
    with pytest.raises(RefusedError, match="none yet"):
        Session().correct(0, Label.SUCCESS)


def test_a_person_is_offered_what_is_possible() -> None:
    assert session(State.WAITING).allowed() == [Event.STOP, Event.START, Event.HOME, Event.FREE]
    assert Event.TIME_UP not in session(State.RUNNING).allowed()
    assert Label is interfaces.Label


def refused(made: Session, event: Event, said: str) -> None:
    """The event is neither offered nor possible, and changes nothing."""
    before = made.snapshot()
    assert event not in made.allowed()
    with pytest.raises(RefusedError, match=said):
        made.apply(event)
    assert made.snapshot() == before


def test_no_episode_starts_while_the_learner_is_busy() -> None:
    made = Session()
    made.learning("offline updates")
    refused(made, Event.START, r"busy \(offline updates\)")
    made.learning("")
    made.apply(Event.START)
    for event in (Event.SUCCESS, Event.FAILURE, Event.DISCARD):
        made.apply(event)  # its end makes the learner busy, before it could say so itself
        made.apply(Event.READY)
        refused(made, Event.START, "storing the episode")
        assert made.snapshot()["busy"] == "storing the episode"
        made.learning("")
        assert made.apply(Event.START) is State.RUNNING


def test_without_a_leader_nobody_takes_over() -> None:
    for path in (PATHS[State.RUNNING], PATHS[State.PAUSED]):
        made = Session(leader=False)
        for event in path:
            made.apply(event)
        refused(made, Event.TAKE_OVER, "There is no leader arm")


def test_an_evaluation_is_the_policys_alone_and_not_learned_from() -> None:
    made = Session()
    made.expect(None)
    made.apply(Event.START)
    assert made.episode == -1
    refused(made, Event.TAKE_OVER, "An evaluation is on")
    made.apply(Event.SUCCESS)
    made.learning("")
    made.expect(7)
    with pytest.raises(RefusedError, match="Evaluations are not learned from"):
        made.correct(-1, Label.FAILURE)
    made.apply(Event.READY)
    made.apply(Event.START)
    assert made.episode == 7
    assert Event.TAKE_OVER in made.allowed()
    made.apply(Event.FAILURE)
    made.learning("")
    made.expect(None)
    made.apply(Event.READY)
    made.apply(Event.START)
    assert made.episode == -2


def test_an_episode_that_is_tried_again_has_no_label_of_before() -> None:
    made = session(State.RESETTING)
    made.learning("")
    made.expect(0)
    made.apply(Event.READY)
    made.apply(Event.START)
    assert (made.episode, made.labels) == (0, {})


def test_breaks_are_counted_once_each() -> None:
    made = session(State.RUNNING)
    assert made.breaks == 0
    made.apply(Event.PAUSE)
    made.apply(Event.RESUME)
    assert made.breaks == 1
    made.apply(Event.TAKE_OVER)
    assert made.breaks == 1
    made.apply(Event.ABSENT)
    assert made.breaks == 2
    made.apply(Event.FAULT, "one")
    made.apply(Event.FAULT, "and the same still")
    assert made.breaks == 3
    made.apply(Event.RECOVERED)
    made.apply(Event.FAILURE)
    assert made.breaks == 3


@pytest.mark.parametrize("event", [Event.PAUSE, Event.ABSENT])
@pytest.mark.parametrize("state", [State.WAITING, State.RESETTING])
def test_on_its_way_home_an_arm_can_be_held_and_needs_somebody(event: Event, state: State) -> None:
    made = session(state)
    refused(made, event, "nothing moves")
    made.note_homing(True)
    assert made.moving
    assert made.apply(event) is state
    assert not made.homing
    assert made.breaks == 0  # no episode was broken off


def test_going_home_is_asked_once_and_forgotten_by_what_comes_next() -> None:
    for state in (State.WAITING, State.RESETTING):
        made = session(state)
        assert not made.take_home()
        made.apply(Event.HOME)
        assert made.take_home()
        assert not made.take_home()
    made = session(State.RESETTING)
    made.learning("")
    made.apply(Event.HOME)
    made.apply(Event.READY)  # the scene is ready while the arm is on its way
    assert made.take_home()
    made.apply(Event.HOME)
    made.apply(Event.START)
    assert not made.take_home()


def test_an_arm_is_let_go_and_taken_again() -> None:
    refused(Session(can_free=False), Event.FREE, "no motor bus")
    made = session(State.RESETTING)
    made.learning("")
    made.apply(Event.HOME)
    made.apply(Event.FREE)
    assert made.free
    assert not made.take_home()  # nobody holds an arm that begins to move by itself
    made.apply(Event.READY)
    assert made.free
    made.apply(Event.FREE)
    assert not made.free
    for event in (Event.HOME, Event.START, Event.STOP):
        made = session(State.WAITING)
        made.apply(Event.FREE)
        made.apply(event)
        assert not made.free


def test_of_two_people_who_press_at_once_one_is_refused() -> None:
    for _ in range(50):
        made, refused = session(State.RUNNING), list[Event]()
        barrier = threading.Barrier(2)

        def press(
            event: Event, made: Session = made, refused: list[Event] = refused, barrier: threading.Barrier = barrier
        ) -> None:
            barrier.wait()
            try:
                made.apply(event)
            except RefusedError:
                refused.append(event)

        threads = [threading.Thread(target=press, args=(e,)) for e in (Event.SUCCESS, Event.FAILURE)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(refused) == 1
        assert made.labels == {0: Label.SUCCESS if refused == [Event.FAILURE] else Label.FAILURE}


def test_after_a_pause_whoever_drove_drives_on() -> None:
    made = session(State.TEACHING)
    made.apply(Event.PAUSE)
    assert made.apply(Event.RESUME) is State.TEACHING
    made.apply(Event.ABSENT)
    assert made.apply(Event.RESUME) is State.TEACHING
    made.apply(Event.HAND_BACK)
    made.apply(Event.PAUSE)
    assert made.apply(Event.RESUME) is State.RUNNING


def test_by_hand_does_not_end_by_itself() -> None:
    """A reading that fails while somebody holds the arm, the recovery, a label: none of them switches motors on."""
    made = session(State.RESETTING)
    made.apply(Event.FREE)
    for event in (Event.FAULT, Event.FAULT, Event.RECOVERED, Event.READY, Event.FAULT, Event.RECOVERED):
        made.apply(event)
        assert made.free
    made.apply(Event.FREE)
    assert not made.free
    driven = session(State.RUNNING)  # broken off, and taken into the hand to be brought back
    for event in (Event.FAULT, Event.FREE, Event.RECOVERED, Event.FAILURE):
        driven.apply(event)
        assert driven.free == (event is not Event.FAULT)
    driven.apply(Event.HOME)
    assert not driven.free


def test_what_could_not_be_held_is_still_free() -> None:
    made = session(State.RESETTING)
    made.apply(Event.FREE)
    made.apply(Event.FREE)
    made.note_free()
    assert made.free
