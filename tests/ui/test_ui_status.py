"""The status of the panel, without a browser: the line, the one reason, what mends it, and the details."""

import html
import re
import threading
from dataclasses import replace
from types import MappingProxyType
from typing import Any, cast

import pytest
from pages import Edited, frame_of, panel_of, wait_until
from scenes import avoiding, beside, biases, changed

from dt_viz.avoidance.bias import BiasPoint
from dt_viz.flows.diffeomorphisms import Integration
from dt_viz.learning.demonstrations import DemonstrationError
from dt_viz.motion.certificates import Certificates, HandTurn
from dt_viz.obstacles.shapes import Sphere
from dt_viz.robot.collision import NOTHING, CollisionReport, Nearest
from dt_viz.scenario.paper_scenes import SCENES
from dt_viz.scenario.scenario import Scenario, View
from dt_viz.scenario.stack import WHOLE_ARM, avoiding_with
from dt_viz.scenario.tasks import TASKS
from dt_viz.scheduler import Jobs
from dt_viz.session.engine import Engine
from dt_viz.session.frame import Frame, Stage
from dt_viz.session.progress import READ, Message, Pace, Progress
from dt_viz.session.session import Session
from dt_viz.ui.tabs.status import (
    BUTTON,
    CHANGED,
    COMPUTING,
    FAILED,
    HOLDS,
    PALE,
    REASON,
    UNDO,
    WARP_HINT,
    Verdict,
    concerns,
    details_html,
    hint,
    remedy,
    verdict,
)
from dt_viz.warning import ARM, Concern, Kind, MotionWarning, Severity

PACE = Pace(0.02, 10.0, 0)
CLOSE = CollisionReport(
    Nearest(-0.008, ("link 5",), 2.5), Nearest(0.004, ("link 2", "hand"), 3.0), Nearest(-0.012, ("finger tip 1",), 4.0)
)
FAR = CollisionReport(Nearest(0.012, ("link 5",), 2.5), None, Nearest(0.034, ("hand",), 4.0))
CLOSE_BY = Certificates(0.01, CLOSE, found=CLOSE.warnings)
HOLDING = Certificates(0.01, FAR, lyapunov_falls=True)
ODD = MotionWarning(Kind.OFF_MOTION, "it is odd")
BIASES = biases(BiasPoint((0.0, -0.5, 0.4)), BiasPoint((0.1, -0.5, 0.4)))
SPHERE = Sphere((0.0, -0.5, 0.4))
HAND, WHOLE = avoiding("draw_s", SPHERE), avoiding("draw_s", SPHERE, space="cspace")


def frame(scenario: Scenario = HAND, **changes: Any) -> Frame:
    return frame_of(scenario, **({"task": TASKS[scenario.task]()} | changes))


def verdict_of(told: Frame, adopted: Scenario | None = None) -> Verdict:
    return verdict(Progress(adopted or told.scenario, told, PACE))


def details_of(told: Frame) -> str:
    return html.unescape(details_html(told, PACE, told.scenario.view))


# --- The line and the reason ---


def test_what_is_sound_is_one_line_of_figures():
    said = verdict_of(frame(certificates=HOLDING))
    assert said == Verdict("✓ safe · 12 mm · stable · 20 ms", Severity.GOOD, HOLDS)
    unstable = frame(certificates=replace(HOLDING, lyapunov_falls=False))
    slow = verdict(Progress(WHOLE, unstable, Pace(1.26, 0, 0)))
    assert slow.line.endswith("not stable · 1.3 s")
    alone = replace(HOLDING, clearance=float("inf"), collision=replace(FAR, obstacle=Nearest(float("inf"), (), 0.0)))
    assert "no obstacle" in verdict_of(frame(certificates=alone)).line


def test_the_clearance_is_of_the_arms_meshes_where_they_are_known_and_shown():
    hidden = replace(HAND, view=View(arm=False))
    for told, adopted, clearance in (
        (frame(certificates=HOLDING), HAND, "12 mm"),
        (frame(certificates=replace(HOLDING, collision=None)), HAND, "10 mm"),
        (frame(hidden, certificates=HOLDING), hidden, "10 mm"),
        (frame(hidden, certificates=HOLDING), HAND, "12 mm"),  # as soon as it is asked for
        (frame(certificates=CLOSE_BY), HAND, "−8 mm"),
    ):
        assert f"· {clearance} ·" in verdict_of(told, adopted).line


@pytest.mark.parametrize(
    "changes",
    [
        {"stage": Stage.FINE},
        {"blocked": (ODD,)},
        {"certificates": HOLDING.warning(ODD)},
        {"certificates": CLOSE_BY},
        {"scenario": replace(HAND, warp=0.5)},
    ],
    ids=["unfinished", "blocked", "warned of", "too close", "warped"],
)
def test_not_every_check_holds_of_what_is(changes):
    said = verdict_of(frame(**{"certificates": HOLDING} | changes))
    assert said.reason != HOLDS and not said.line.startswith("✓")


def test_what_is_computed_says_so_and_a_warning_that_is_known_stays():
    told = frame(certificates=HOLDING)
    moved = changed(told.scenario, temperature=3.0)
    for said in (verdict_of(told, moved), verdict_of(replace(told, stage=Stage.LIVE))):
        assert said.busy and said.line.startswith(COMPUTING) and "12 mm" in said.line and said.reason == ""
    looked_at = replace(told.scenario, view=View(rollouts=False))
    assert not verdict_of(told, looked_at).busy  # the frame has all that it needs
    live = verdict_of(frame(certificates=HOLDING.warning(ODD), stage=Stage.LIVE))
    assert live.busy and (live.reason, live.severity) == ("it is odd", Severity.WARNING)


def test_the_gravest_reason_comes_first_whatever_order_they_are_found_in():
    by_concern = [
        MotionWarning(Kind.ENTERS, "it enters"),
        ODD,
        MotionWarning(Kind.TOO_NEAR, "it is near"),
        MotionWarning(Kind.GOAL_MISSED, "it misses"),
    ]
    for found in (by_concern, by_concern[::-1]):
        told = frame(certificates=HOLDING.warning(*found))
        assert [*concerns(told, View())] == by_concern
        assert verdict_of(told).reason == "it enters; it is odd (and 2 more: see Details)"
    pair = frame(certificates=HOLDING.warning(*by_concern[:2]))
    assert verdict_of(pair).reason == "it enters; it is odd"
    for concern, warning in zip(Concern, by_concern, strict=True):
        said = verdict_of(frame(certificates=HOLDING.warning(warning)))
        assert said.line[2:].startswith(concern.value) and said.severity is concern.severity


@pytest.mark.parametrize(
    ("view", "told"), [(View(), True), (View(arm=False, onion=True), True), (View(arm=False), False)]
)
def test_nothing_is_said_of_an_arm_that_is_hidden(view, told):
    known = replace(CLOSE_BY, lyapunov_falls=True).warning(MotionWarning(Kind.DAMPED, "the arm is odd", ARM))
    shown = frame(avoiding("draw_s", (), view=view), certificates=known)
    details, said = details_of(shown), verdict_of(shown)
    for text in ("The arm is odd", "below the table", "Arm to obstacle", "finger"):
        assert (text in details) == told
    assert (said.severity is Severity.GOOD) == (not told) and ("link 5" in said.reason) == told
    assert "It is odd" in details_of(replace(shown, certificates=known.warning(ODD)))  # of the rollouts


@pytest.mark.parametrize(("space", "hinted"), [("task", True), ("cspace", False)])
def test_where_the_hand_alone_gives_way_that_is_told(space, hinted):
    told = frame(changed(HAND, space=space), certificates=CLOSE_BY)
    assert ("only the path of the hand" in verdict_of(told).reason) == hinted


def test_motions_through_an_obstacle_are_a_collision_also_where_nothing_warns():
    inside = Certificates(-0.03, lyapunov_falls=True)
    for changes, why in (({"duration": 0.1}, "at this flow time"), ({"avoids": False}, "nothing avoids it")):
        said = verdict_of(frame(changed(HAND, **changes), certificates=inside))
        assert said.severity is Severity.ALARM and why in said.reason and "−30 mm" in said.line


def test_a_warp_is_a_hint_and_what_it_enters_no_alarm():
    warped = replace(HAND, warp=0.5)
    inside = frame(warped, certificates=Certificates(-0.03, lyapunov_falls=True))
    assert concerns(inside, View()) == ()
    assert (verdict_of(inside).severity, verdict_of(inside).reason) == (Severity.NOTE, WARP_HINT.format(0.5))
    table = CollisionReport(Nearest(-0.04, ("finger 1",), 0), None, Nearest(-0.02, ("link 5",), 0))
    found = tuple(warning for warning in table.warnings if warning.kind is not Kind.ARM_ENTERS)  # as of a warp
    below = frame(warped, certificates=Certificates(-0.03, table, found=found))
    assert [warning.kind for warning in concerns(below, View())] == [Kind.ARM_BELOW_TABLE]


def test_a_scenario_without_motion_says_why_and_what_is_shown_instead():
    texts = ("start 3 is inside the obstacle", "the obstacle touches the <base>")
    told = frame(blocked=tuple(MotionWarning(Kind.ARM_BLOCKED, text) for text in texts))
    said = verdict_of(told)
    assert said.severity is Severity.ALARM and "; ".join(texts) in said.reason and "last good" in said.reason
    assert "mm" not in said.line
    details = details_html(told, PACE, View())
    assert "The obstacle touches the &lt;base&gt;" in details
    row = details.split(">Clearance<")[1].split("</tr>")[0]
    assert "–" in row and "mm" not in row


def test_the_line_of_a_scene_is_shown_only_while_it_is_as_it_was():
    task = TASKS["draw_j"]()
    scene = SCENES["two_points"]
    own = scene.scenario(task)
    assert hint(frame(avoiding("draw_j", ()))) == task.hint
    assert hint(frame(own)) == hint(frame(replace(own, warp=0.3))) == scene.line
    assert hint(frame(changed(own, layers=beside(own)[:1]))) == CHANGED


# --- The details ---


TOUCHES = replace(FAR, itself=Nearest(0.0, ("link 2", "hand"), 1.0))


COVERED = CollisionReport(NOTHING, None, Nearest(0.034, ("hand",), 4.0))
BIASED = changed(HAND, layers=BIASES)
TURNED = Certificates(0.02, turn=HandTurn(0.24, 7.6))


def arm_to(*places: str) -> dict[str, str]:
    return dict(zip(("Arm to obstacle", "Arm to itself", "Arm to table"), places, strict=False))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"certificates": HOLDING}, arm_to("12 mm, link 5", "over 50 mm", "34 mm, hand")),
        (
            {"certificates": CLOSE_BY},
            arm_to("enters by 8 mm, link 5", "4 mm, link 2 – hand", "below by 12 mm, finger tip 1"),
        ),
        ({"certificates": Certificates(0.01, TOUCHES)}, arm_to("12 mm, link 5", "touches, link 2 – hand")),
        ({"certificates": Certificates(0.01, COVERED)}, arm_to("no obstacle")),
        ({"stage": Stage.LIVE}, arm_to("…")),
        ({"stage": Stage.CERTIFIED}, arm_to("–")),
        ({"durations": {"Avoidance": 0.85}}, {"Flow time t": "0.85", "Strength": None}),
        ({"durations": {WHOLE_ARM: 0.5}}, {"Flow time t": "0.50", "Strength": None}),
        ({"durations": {}}, {"Flow time t": "off", "Strength": None}),
        ({"scenario": BIASED, "durations": {"Bias 1": 0.8}}, {"Flow time t": None, "Strength": "0.80 Bias 1"}),
        (
            {"scenario": BIASED, "durations": {"Bias 1": 0.8, "Avoidance": 0.4}},
            {"Flow time t": "0.40", "Strength": "0.80 Bias 1"},
        ),
        ({"scenario": HAND}, {"Clearance": "10.0 mm, end effector, all motions"}),
        ({"scenario": WHOLE}, {"Clearance": "10.0 mm, body points, all motions"}),
        ({"scenario": changed(WHOLE, avoids=False)}, {"Clearance": "10.0 mm, end effector, all motions"}),
        *(
            ({"certificates": Certificates(1, round_trip_error=error)}, {"Round trip": said})
            for error, said in (
                (0.0, "exact"),
                (3e-9, "< 0.001 mm"),
                (9.9e-7, "< 0.001 mm"),
                (2.51e-5, "0.025 mm"),
                (0.2471, "247 mm"),
            )
        ),
        ({"certificates": TURNED}, {"Hand turned": None}),
        ({"certificates": TURNED, "has_orientation": True}, {"Hand turned": "0.2°, at most 8°"}),
        ({"has_orientation": True}, {"Hand turned": "–"}),
    ],
)
def test_the_details_say(changes, said):
    rows = dict(re.findall(r"<td[^>]*>([^<]*)</td><td[^>]*>(.*?)</td>", details_of(frame(**changes))))
    assert {name: rows.get(name) for name in said} == said


def test_what_enters_is_said_once_also_if_a_rollout_is_known_to_enter():
    enters, *others = CLOSE.warnings
    known = CLOSE_BY.warning(MotionWarning(Kind.ROLLOUT_ENTERS, f"rollout 2: {enters}", ARM))
    said = details_of(frame(certificates=known))
    assert said.lower().count(enters.text.lower()) == 1
    assert others and all(other.text[1:] in said for other in others)


# --- Remedies ---

ENTERS = Certificates(0.01).warning(MotionWarning(Kind.ARM_ENTERS, "finger tip 1 enters the obstacle by 64 mm", ARM))


def test_the_whole_arm_is_let_avoid_where_that_mends():
    told = frame(certificates=ENTERS)
    found = remedy(told, Progress(HAND))
    assert found is not None and found.label == "Let the whole arm avoid"
    assert replace(HAND, **found.changes or {}) == WHOLE
    for scenario in (WHOLE, replace(HAND, view=View(arm=False))):
        assert remedy(replace(told, scenario=scenario), Progress(scenario)) is None
    assert remedy(told, Progress(changed(HAND, temperature=3.0))) is None  # it is of another motion


def test_what_nothing_else_mends_is_mended_by_undo_where_there_is_a_step():
    for told in (frame(blocked=(ODD,)), frame(certificates=Certificates(0.01).warning(ODD))):
        assert remedy(told, Progress(HAND, steps=(True, False))) is UNDO
        assert remedy(told, Progress(HAND, steps=(True, False), beside=(True, False))) is None  # it undoes a take
    assert remedy(frame(), Progress(HAND, steps=(True, True))) is None


def test_obstacles_without_a_way_around_are_taken_away_where_there_is_no_step_back():
    found = remedy(frame(blocked=(ODD,)), Progress(HAND))
    assert found is not None and found.label == "Take the obstacles away"
    assert replace(HAND, **found.changes or {}) == changed(HAND, obstacles=())
    without = changed(HAND, obstacles=())
    assert remedy(frame(without, blocked=(ODD,)), Progress(without)) is None
    assert remedy(frame(certificates=Certificates(0.01).warning(ODD)), Progress(HAND)) is None  # there is a way


IN_STROKE = Sphere(TASKS["draw_s"]().obstacle_position, 0.12)
SPOILED: dict[str, dict[str, Any]] = {
    "coarse steps": {"integration": Integration("euler", 2)},
    "inexact steps": {"integration": Integration("euler", 50)},
    "flow time": {"duration": 0.02},
    "generator": {"generator": "probability"},
    "off": {"stack": avoiding_with(avoiding("draw_s", IN_STROKE), None)},
    "warp": {"warp": 0.4},
}


@pytest.mark.parametrize("name", SPOILED)
def test_a_remedy_mends_what_it_is_offered_for(name, engine: Engine):
    """Where only the hand's path is looked at: nothing is left to be told once the button is pressed."""
    scenario = avoiding("draw_s", IN_STROKE, view=View(arm=False, field=False), **SPOILED[name])
    *_, told = engine.frames(scenario)
    assert verdict_of(told).severity is not Severity.GOOD
    found = remedy(told, Progress(scenario))
    assert found is not None and found.changes is not None
    *_, told = engine.frames(replace(scenario, **found.changes))
    assert verdict_of(told).severity is Severity.GOOD, verdict_of(told)


# --- What is shown when ---


class Told:
    """What a session tells its panel."""

    taught: Any = MappingProxyType({})

    def __init__(self, panel: Any, scenario: Scenario) -> None:
        self.panel, self.progress = panel, Progress(scenario)
        self.adopt(scenario)

    def tell(self, **changes: Any) -> None:
        self.progress = replace(self.progress, **changes)
        self.panel.tell(self.progress)

    def adopt(self, scenario: Scenario) -> None:
        self.panel.adopt(scenario)
        self.tell(wanted=scenario)

    def report(self, shown: Frame) -> None:
        self.panel.report(shown)
        self.tell(shown=shown, pace=PACE)

    def say(self, text: str, severity: Severity = Severity.ALARM) -> None:
        self.tell(message=Message(text, severity, self.progress.wanted))


def heights(panel) -> float:
    """Height of the status, em, but for its details."""
    (line,) = re.findall(r"role='status'[^>]*height:([\d.]+)em;line", panel.status.line.content)
    (room,) = re.findall(r"<div style='height:([\d.]+)em;overflow:hidden;margin", panel.status.line.content)
    return float(line) + float(room) + BUTTON * (panel.status.mend.visible + panel.status.cancel.visible)


def test_nothing_moves_when_a_message_comes_or_something_is_learned(panel):
    told = Told(panel, HAND)
    full = heights(panel)
    for act, text, mends, cancels in (
        (lambda: told.report(frame(certificates=HOLDING)), "Every check", False, False),
        (lambda: told.report(frame(certificates=ENTERS)), "Finger tip 1", True, False),
        (lambda: told.tell(learning=(0.4, "flow 2 of 3")), "learning the motion … 40 %", False, True),
        (lambda: told.tell(learning=(0.4, "flow 2 of 3")), "Flow 2 of 3", False, True),
        (lambda: told.tell(learning=None), "Finger tip 1", True, False),
        (lambda: told.say("it fails"), "it fails", False, False),
    ):
        act()
        assert heights(panel) == full >= REASON
        assert text in html.unescape(panel.status.line.content)
        assert (panel.status.mend.visible, panel.status.cancel.visible) == (mends, cancels)


def test_the_button_mends_what_the_session_has_now(panel):
    edited = Edited(HAND, panel)
    panel.connect(cast(Session, edited))
    Told(panel, HAND).report(frame(certificates=ENTERS))
    assert panel.status.mend.label == "Let the whole arm avoid"
    for _ in range(2):
        panel.status._mend(cast(Session, edited))
        assert edited.scenario == WHOLE and edited.steps == 1


def test_what_is_refused_is_said_beside_the_panel_too(server):
    said = []
    panel = panel_of(server, notify=lambda *told: said.append(told))
    told = Told(panel, HAND)
    told.say("file.csv: points: found 3; accepted: at least 20")
    told.report(frame())  # the message stays
    ((text, colour),) = said
    assert "at least 20" in text and text in html.unescape(panel.status.line.content)
    assert colour[0] > 2 * max(colour[1:])  # red
    server.gui.reset()


@pytest.fixture
def page(opened_for):
    """A page of its own: panels of other tests take away all controls when they end."""
    return opened_for(None)


def test_a_notice_leaves_the_scene_long_before_the_status_line_forgets_it(page, monkeypatch):
    shown = []
    monkeypatch.setattr(page.client, "add_notification", lambda _title, text, **how: shown.append((text, how)))
    page.session.say("file.csv: points: found 3; accepted: at least 20", Severity.ALARM)
    ((text, how),) = shown
    assert text in html.unescape(page.visitor._panel.status.line.content)
    assert 3.0 < how["auto_close_seconds"] < READ / 4


def test_the_status_of_another_task_is_pale_and_says_what_is_done(panel):
    scenario, other = avoiding("draw_s", ()), avoiding("lift_box", ())
    first, second = frame(scenario), frame(other)
    status = panel.status

    def hinted(said):
        return said.task.hint in html.unescape(panel.hint.content)

    told = Told(panel, scenario)
    told.report(first)
    settled = status.details.content
    assert COMPUTING not in status.line.content and hinted(first)
    told.adopt(other)
    for _ in range(2):
        assert COMPUTING in status.line.content and status.details.content == f"<div style='{PALE}'>{settled}</div>"
        assert not hinted(first)
        told.report(first)  # what was under way when it was chosen
    told.report(second)
    assert COMPUTING not in status.line.content and hinted(second)
    told.adopt(scenario)
    assert COMPUTING in status.line.content
    told.tell(failed=True)
    assert FAILED.line in status.line.content and COMPUTING not in status.line.content
    told.adopt(other)
    told.tell(failed=False)
    assert FAILED.line not in status.line.content and hinted(second)


def test_what_fails_beside_a_motion_that_is_known_leaves_its_verdict(panel):
    told = Told(panel, HAND)
    told.report(frame(certificates=HOLDING))
    told.tell(failed=True)
    told.say("no picture")
    assert "✓ safe" in panel.status.line.content and "no picture" in panel.status.line.content.lower()


class Begun(Told):
    """A session that begins what it is told to once it may."""

    def __init__(self, panel, scenario):
        self.may, self.asked = threading.Event(), []
        self.jobs = Jobs(lambda error: self.say(str(error)))
        super().__init__(panel, scenario)

    def expect(self, expected):
        self.tell(expected=expected)

    def choose_task(self, name):
        assert self.may.wait(30)
        self.asked.append(name)
        if name == "push_box":
            raise DemonstrationError("push.csv", "lines", "none", "two or more")
        self.adopt(replace(self.progress.wanted, task=name))


@pytest.mark.parametrize(("chosen", "settles"), [("lift_box", False), ("draw_s", True), ("push_box", True)])
def test_choosing_a_task_keeps_nobody_waiting_and_says_at_once_what_is_done(panel, chosen, settles):
    session = Begun(panel, avoiding("draw_s", ()))
    panel.connect(cast(Session, session))
    session.report(frame(session.progress.wanted))
    settled = panel.status.details.content, panel.hint.content
    panel.begin(lambda session, name: session.choose_task(name), cast(Session, session), chosen)
    assert COMPUTING in panel.status.line.content and session.asked == []
    session.may.set()
    assert session.jobs.wait_idle(timeout=30)
    assert session.asked == [chosen]
    assert (COMPUTING not in panel.status.line.content) == settles
    assert ((panel.status.details.content, panel.hint.content) == settled) == settles
    assert ("push.csv" in panel.status.line.content) == (chosen == "push_box")


def test_a_message_passes_on_a_page_that_nobody_touches(page, monkeypatch):
    page.session.say("places left out", Severity.WARNING)
    assert "places left out" in page.visitor._panel.status.line.content
    monkeypatch.setattr("dt_viz.session.progress.READ", 0.0)
    wait_until(lambda: "places left out" not in page.visitor._panel.status.line.content)
