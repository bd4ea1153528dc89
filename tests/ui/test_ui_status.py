"""The status of the panel, without a browser: the line, the one reason, what mends it, and the details."""

import html
import re
import textwrap
import threading
from dataclasses import replace
from typing import Any, cast

import pytest
from pages import Edited, frame_of, panel_of
from scenes import avoiding, beside, biases, changed

from dt_viz.arm.collision import CollisionReport, Nearest
from dt_viz.engine.engine import Engine
from dt_viz.engine.frame import Frame, Stage
from dt_viz.engine.session import Pace, Session
from dt_viz.flows.diffeomorphisms import Integration
from dt_viz.learning.demonstrations import DemonstrationError
from dt_viz.motion.certificates import Certificates
from dt_viz.obstacles.shapes import Sphere
from dt_viz.scenario.paper_scenes import SCENES
from dt_viz.scenario.scenario import Scenario, View
from dt_viz.scenario.stack import avoiding_with
from dt_viz.scenario.tasks import TASKS
from dt_viz.transforms.bias import BiasPoint
from dt_viz.ui.panel.remedies import remedy
from dt_viz.ui.panel.status import CHANGED, HINT, LEADING, PALE, details_html, error_text, hint
from dt_viz.ui.panel.status_line import BUTTON, HEIGHT
from dt_viz.ui.panel.verdict import COMPUTING, CONCERNS, FAILED, HOLDS, WARP_HINT, Level, Verdict, concerns, verdict
from dt_viz.warning import ARM, Kind, MotionWarning

PACE = Pace(0.02, 10.0, 0)
CLOSE = CollisionReport(
    Nearest(-0.008, ("link 5",), 2.5), Nearest(0.004, ("link 2", "hand"), 3.0), Nearest(-0.012, ("finger tip 1",), 4.0)
)
FAR = CollisionReport(Nearest(0.012, ("link 5",), 2.5), None, Nearest(0.034, ("hand",), 4.0))
CLOSE_BY = Certificates(0.01, CLOSE, found=CLOSE.warnings)
HOLDING = Certificates(0.01, FAR, lyapunov_falls=True)
ODD = MotionWarning(Kind.OFF_MOTION, "it is odd")
SPHERE = Sphere((0.0, -0.5, 0.4))
WHOLE = avoiding("draw_s", SPHERE, space="cspace")


def frame(**changes: Any) -> Frame:
    return frame_of(changes.pop("scenario", avoiding("draw_s", SPHERE)), **changes)


def verdict_of(told: Frame, adopted: Scenario | None = None) -> Verdict:
    return verdict(told, PACE, adopted or told.scenario)


def details_of(told: Frame) -> str:
    return html.unescape(details_html(told, PACE, told.scenario.view))


# --- The line and the reason ---


def test_what_is_sound_is_one_line_of_figures():
    said = verdict_of(frame(certificates=HOLDING))
    assert said == Verdict("✓ safe · 12 mm · stable · 20 ms", Level.GOOD, HOLDS)
    slow = verdict(frame(certificates=replace(HOLDING, lyapunov_falls=False)), Pace(1.26, 0, 0), WHOLE)
    assert slow.line.endswith("not stable · 1.3 s")
    alone = replace(HOLDING, clearance=float("inf"), collision=replace(FAR, obstacle=Nearest(float("inf"), (), 0.0)))
    assert "no obstacle" in verdict_of(frame(certificates=alone)).line


def test_the_clearance_is_of_the_arms_meshes_where_they_are_known_and_shown():
    hidden = avoiding("draw_s", SPHERE, view=View(arm=False))
    for told, clearance in (
        (frame(certificates=HOLDING), "12 mm"),
        (frame(certificates=replace(HOLDING, collision=None)), "10 mm"),
        (frame(certificates=HOLDING, scenario=hidden), "10 mm"),
        (frame(certificates=CLOSE_BY), "−8 mm"),
    ):
        assert f"· {clearance} ·" in verdict_of(told).line
    shown = replace(hidden, view=View())
    assert "· 12 mm ·" in verdict_of(frame(certificates=HOLDING, scenario=hidden), shown).line  # as soon as it is asked


def test_every_check_holds_only_when_all_are_made():
    assert verdict_of(frame(certificates=HOLDING)).reason == HOLDS
    for other in (
        frame(certificates=HOLDING, stage=Stage.FINE),
        frame(certificates=HOLDING, blocked=(ODD,)),
        frame(certificates=HOLDING.warning(ODD)),
        frame(certificates=CLOSE_BY),
        frame(certificates=HOLDING, scenario=avoiding("draw_s", (), warp=0.5)),
    ):
        said = verdict_of(other)
        assert said.reason != HOLDS and not said.line.startswith("✓")


def test_what_is_computed_says_so_and_a_warning_that_is_known_stays():
    told = frame(certificates=HOLDING)
    moved = changed(told.scenario, temperature=3.0)
    for said in (verdict_of(told, moved), verdict_of(replace(told, stage=Stage.LIVE))):
        assert said.busy and said.line.startswith(COMPUTING) and "12 mm" in said.line and said.reason == ""
    looked_at = replace(told.scenario, view=View(rollouts=False))
    assert not verdict_of(told, looked_at).busy  # the frame has all that it needs
    live = verdict_of(frame(certificates=HOLDING.warning(ODD), stage=Stage.LIVE))
    assert live.busy and (live.reason, live.level) == ("it is odd", Level.WARNING)


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
        assert verdict_of(told).reason == "it enters (and 3 more: see Details)"
    for k, warning in enumerate(by_concern):
        said = verdict_of(frame(certificates=HOLDING.warning(warning)))
        assert said.line.startswith(CONCERNS[k].head) and said.level is CONCERNS[k].level
    assert len({kind for concern in CONCERNS for kind in concern.kinds}) == sum(len(c.kinds) for c in CONCERNS)


@pytest.mark.parametrize(
    ("view", "told"), [(View(), True), (View(arm=False, onion=True), True), (View(arm=False), False)]
)
def test_nothing_is_said_of_an_arm_that_is_hidden(view, told):
    known = replace(CLOSE_BY, lyapunov_falls=True).warning(MotionWarning(Kind.DAMPED, "the arm is odd", ARM))
    shown = frame(scenario=avoiding("draw_s", (), view=view), certificates=known)
    details, said = details_of(shown), verdict_of(shown)
    for text in ("The arm is odd", "below the table", "Arm to obstacle", "finger"):
        assert (text in details) == told
    assert (said.level is Level.GOOD) == (not told) and ("link 5" in said.reason) == told
    rollouts = frame(scenario=shown.scenario, certificates=known.warning(ODD))
    assert "It is odd" in details_of(rollouts)


@pytest.mark.parametrize(("space", "hinted"), [("task", True), ("cspace", False)])
def test_where_the_hand_alone_gives_way_that_is_told(space, hinted):
    told = frame(scenario=avoiding("draw_s", (SPHERE,), space=space), certificates=CLOSE_BY)
    assert ("only the path of the hand" in verdict_of(told).reason) == hinted


def test_motions_through_an_obstacle_are_a_collision_also_where_nothing_warns():
    inside = Certificates(-0.03, lyapunov_falls=True)
    for scenario, why in (
        (avoiding("draw_s", SPHERE, duration=0.1), "at this flow time"),
        (avoiding("draw_s", SPHERE, avoids=False), "nothing avoids it"),
    ):
        said = verdict_of(frame(scenario=scenario, certificates=inside))
        assert said.level is Level.ALARM and why in said.reason and "−30 mm" in said.line
    warped = frame(scenario=avoiding("draw_s", SPHERE, warp=0.5), certificates=inside)
    said = verdict_of(warped)
    assert concerns(warped, View()) == ()
    assert said.level is Level.NOTE and said.reason == WARP_HINT.format(0.5)


def test_a_scenario_without_motion_says_why_and_what_is_shown_instead():
    texts = ("start 3 is inside the obstacle", "the obstacle touches the <base>")
    told = frame(blocked=tuple(MotionWarning(Kind.ARM_BLOCKED, text) for text in texts))
    said = verdict_of(told)
    assert said.level is Level.ALARM and "; ".join(texts) in said.reason and "last good" in said.reason
    assert "mm" not in said.line
    details = details_html(told, PACE, View())
    assert "The obstacle touches the &lt;base&gt;" in details
    row = details.split(">Clearance<")[1].split("</tr>")[0]
    assert "–" in row and "mm" not in row


def test_the_line_of_a_scene_is_shown_only_while_it_is_as_it_was():
    task = TASKS["draw_j"]()
    scene, plain = SCENES["two_points"], avoiding("draw_j", ())
    own = scene.scenario(task)
    assert hint(frame(scenario=plain, task=task)) == task.hint
    assert hint(frame(scenario=own, task=task)) == hint(frame(scenario=replace(own, warp=0.3), task=task)) == scene.line
    assert hint(frame(scenario=changed(own, layers=beside(own)[:1]), task=task)) == CHANGED


# --- The details ---


def test_the_details_say_what_the_arm_comes_near_to():
    far = details_of(frame(certificates=Certificates(0.01, FAR)))
    for text in ("12 mm, link 5", "over 50 mm", "34 mm, hand"):
        assert text in far
    close = details_of(frame(certificates=CLOSE_BY))
    for text in ("enters by 8 mm, link 5", "4 mm, link 2 – hand", "below by 12 mm, finger tip 1"):
        assert text in close
    hit = replace(FAR, itself=Nearest(0.0, ("link 2", "hand"), 1.0))
    assert "touches, link 2 – hand" in details_of(frame(certificates=Certificates(0.01, hit)))


@pytest.mark.parametrize(
    ("hand", "arm", "said"),
    [(0.85, None, ">0.85<"), (None, 0.5, ">0.50<"), (None, None, ">off<")],
)
def test_the_details_say_which_flow_runs_how_long(hand, arm, said):
    assert said in details_of(frame(durations=(hand,), arm_duration=arm))


@pytest.mark.parametrize(("hand", "flow_time"), [(None, False), (0.4, True)])
def test_the_details_call_what_a_bias_point_has_its_strength(hand, flow_time):
    layers = biases(BiasPoint((0.0, -0.5, 0.4)), BiasPoint((0.1, -0.5, 0.4)))
    said = details_of(frame(scenario=avoiding("draw_s", (), layers=layers), durations=(0.8, None, hand)))
    assert ">0.80 Bias 1<" in said and ">Strength<" in said
    assert ("Flow time t" in said) == flow_time and ">off<" not in said


def test_no_value_of_the_details_runs_out_of_the_panel_and_each_row_explains_itself():
    layers = biases(BiasPoint((0.0, -0.5, 0.4)))
    told = frame(scenario=avoiding("draw_s", (), layers=layers), certificates=HOLDING, durations=(0.8, 0.4))
    said = details_html(told, PACE, View())
    names, values = re.findall(r"<td style='([^']*)'>", said)[::2], re.findall(r"<td style='([^']*)'>", said)[1::2]
    assert all("nowrap" in style for style in names) and not any("nowrap" in style for style in values)
    tooltips = re.findall(r"<tr [^>]*title='([^']{30,})'", said)
    assert len(set(tooltips)) == said.count("<tr") == 10


@pytest.mark.parametrize(
    ("error", "said"),
    [(0.0, "exact"), (3e-9, "< 0.001 mm"), (9.9e-7, "< 0.001 mm"), (2.51e-5, "0.025 mm"), (0.2471, "247 mm")],
)
def test_what_is_lost_is_in_units_that_a_person_uses(error, said):
    assert error_text(error) == said
    assert f">{html.escape(said)}<" in details_html(
        frame(certificates=Certificates(1, round_trip_error=error)), PACE, View()
    )


@pytest.mark.parametrize(
    ("space", "avoidance", "whose"),
    [("task", True, "end effector"), ("cspace", True, "body points"), ("cspace", False, "end effector")],
)
def test_the_details_say_whose_clearance_it_is(space, avoidance, whose):
    scenario = avoiding("draw_s", (SPHERE,), space=space, avoids=avoidance)
    assert f"10.0 mm, {whose}" in details_of(frame(scenario=scenario))


def test_what_enters_is_said_once_also_if_a_rollout_is_known_to_enter():
    enters, *others = CLOSE.warnings
    known = CLOSE_BY.warning(MotionWarning(Kind.ROLLOUT_ENTERS, f"rollout 2: {enters}", ARM))
    said = details_of(frame(certificates=known))
    assert said.lower().count(enters.text.lower()) == 1
    assert others and all(other.text[1:] in said for other in others)


@pytest.mark.parametrize(("stage", "unknown"), [(Stage.LIVE, "…"), (Stage.CERTIFIED, "–")])
def test_what_is_not_known_yet_and_what_will_not_be_known_differ(stage, unknown):
    row = details_of(frame(stage=stage)).split("Arm to obstacle")[1]
    assert row.split("</tr>")[0].count(unknown) == 1


# --- Remedies ---

ENTERS = Certificates(0.01).warning(MotionWarning(Kind.ARM_ENTERS, "finger tip 1 enters the obstacle by 64 mm", ARM))


def test_the_whole_arm_is_let_avoid_where_that_mends():
    hand = avoiding("draw_s", SPHERE)
    found = remedy(frame(certificates=ENTERS), hand)
    assert found is not None and found.label == "Let the whole arm avoid"
    assert replace(hand, **found.changes) == WHOLE
    for scenario in (WHOLE, replace(hand, view=View(arm=False))):
        assert remedy(frame(scenario=scenario, certificates=ENTERS), scenario) is None
    assert remedy(frame(), hand) is None
    assert remedy(frame(certificates=ENTERS), changed(hand, temperature=3.0)) is None  # it is of another motion
    assert remedy(frame(certificates=ENTERS, blocked=(ODD,)), hand) is None
    assert remedy(frame(certificates=Certificates(0.01).warning(ODD)), hand) is None


IN_STROKE = Sphere(TASKS["draw_s"]().obstacle_position, 0.12)
SPOILED = {
    "coarse steps": changed(avoiding("draw_s", IN_STROKE), integration=Integration("euler", 2)),
    "inexact steps": changed(avoiding("draw_s", IN_STROKE), integration=Integration("euler", 50)),
    "flow time": changed(avoiding("draw_s", IN_STROKE), duration=0.02),
    "generator": changed(avoiding("draw_s", IN_STROKE), generator="probability"),
    "off": replace(avoiding("draw_s", IN_STROKE), stack=avoiding_with(avoiding("draw_s", IN_STROKE), None)),
    "warp": replace(avoiding("draw_s", IN_STROKE), warp=0.4),
}


@pytest.mark.parametrize("name", SPOILED)
def test_a_remedy_mends_what_it_is_offered_for(name, engine: Engine):
    """Where only the hand's path is looked at: nothing is left to be told once the button is pressed."""
    scenario = replace(SPOILED[name], view=View(arm=False, field=False))
    *_, told = engine.frames(scenario)
    assert verdict_of(told).level is not Level.GOOD
    found = remedy(told, scenario)
    assert found is not None
    mended = replace(scenario, **found.changes)
    *_, told = engine.frames(mended)
    assert verdict_of(told).level is Level.GOOD, verdict_of(told)


# --- What is shown when ---


@pytest.fixture
def panel(server):
    panel = panel_of(server)
    yield panel
    panel.close()
    server.gui.reset()


def heights(panel) -> float:
    """Height of the status, em, but for its details."""
    (line,) = re.findall(r"role='status'[^>]*height:([\d.]+)em;line", panel.status.line.content)
    (room,) = re.findall(r"<div style='height:([\d.]+)em;overflow:hidden;margin", panel.status.line.content)
    return float(line) + float(room) + BUTTON * (panel.status.mend.visible + panel.status.cancel.visible)


def test_nothing_moves_when_a_message_comes_or_something_is_learned(panel):
    scenario = avoiding("draw_s", SPHERE)
    full = heights(panel)
    panel.adopt(scenario)
    seen = []

    def look():
        assert heights(panel) == full >= HEIGHT
        seen.append((html.unescape(panel.status.line.content), panel.status.mend.visible, panel.status.cancel.visible))

    for act in (
        lambda: panel.report(replace(frame(certificates=HOLDING), task=TASKS["draw_s"]()), PACE),
        lambda: panel.report(replace(frame(certificates=ENTERS), task=TASKS["draw_s"]()), PACE),
        lambda: panel.learning(0.4, "flow 2 of 3"),
        lambda: panel.cancelled("draw_s"),
        lambda: panel.fail(ValueError("it fails")),
    ):
        act()
        look()
    texts, mends, cancels = zip(*seen, strict=True)
    for text, expected in zip(
        texts, ("Every check", "Finger tip 1", "Flow 2 of 3", "was cancelled", "it fails"), strict=True
    ):
        assert expected in text
    assert mends == (False, True, False, False, False) and cancels == (False, False, True, False, False)
    assert "learning the motion … 40 %" in texts[2]


def test_hints_take_the_same_room_and_are_told_in_full(panel):
    """A line of the panel holds about 44 characters."""
    texts = [scene.line for scene in SCENES.values()] + [entry().hint for entry in TASKS.values()] + [CHANGED, ""]
    rooms = set()
    for text in texts:
        panel._give_hint(text)
        rooms |= set(re.findall(r"<div style='height:([\d.]+)em", panel.hint.content))
        assert text in html.unescape(panel.hint.content)
        assert len(textwrap.wrap(text, 44)) * LEADING <= HINT
    assert rooms == {f"{HINT:.3f}"}


def test_a_message_goes_with_the_next_scenario_that_is_shown(panel):
    scenario = avoiding("draw_s", SPHERE)
    panel.adopt(scenario)
    panel.fail(ValueError("it fails"))
    for shown, stays in ((scenario, True), (changed(scenario, temperature=3.0), False)):
        panel.report(replace(frame(scenario=shown, certificates=HOLDING), task=TASKS["draw_s"]()), PACE)
        assert ("it fails" in panel.status.line.content) == stays


def test_the_button_mends_what_the_session_has_now(panel):
    edited = Edited(avoiding("draw_s", SPHERE), panel)
    panel.connect(cast(Session, edited))
    panel.report(replace(frame(certificates=ENTERS), task=TASKS["draw_s"]()), PACE)
    assert panel.status.mend.label == "Let the whole arm avoid"
    panel.status._mend(cast(Session, edited))
    assert edited.scenario == WHOLE and edited.steps == 1
    panel.status._mend(cast(Session, edited))
    assert edited.scenario == WHOLE and edited.steps == 1


def test_what_is_refused_is_said_beside_the_panel_too(server):
    said = []
    panel = panel_of(server, notify=lambda *told: said.append(told))
    panel.fail(DemonstrationError("file.csv", "points", "3", "at least 20"))
    ((text, colour),) = said
    assert "file.csv" in text and "at least 20" in text and text in html.unescape(panel.status.line.content)
    assert colour[0] > 2 * max(colour[1:])  # red
    panel.close()
    server.gui.reset()


def test_the_status_of_another_task_is_pale_and_says_what_is_done(panel):
    scenario, other = avoiding("draw_s", ()), avoiding("lift_box", ())
    said = {s.task: replace(frame(scenario=s), task=TASKS[s.task]()) for s in (scenario, other)}
    status = panel.status
    panel.adopt(scenario)
    panel.report(said["draw_s"], PACE)
    settled = status.details.content
    assert COMPUTING not in status.line.content and said["draw_s"].task.hint in html.unescape(panel.hint.content)
    panel.adopt(other)
    for _ in range(2):
        assert COMPUTING in status.line.content and status.details.content == f"<div style='{PALE}'>{settled}</div>"
        assert said["draw_s"].task.hint not in html.unescape(panel.hint.content)
        panel.report(said["draw_s"], PACE)  # what was under way when it was chosen
    panel.report(said["lift_box"], PACE)
    assert COMPUTING not in status.line.content
    assert said["lift_box"].task.hint in html.unescape(panel.hint.content)
    panel.adopt(scenario)
    assert COMPUTING in status.line.content
    panel.fail(ValueError("nothing comes"))
    assert FAILED.line in status.line.content and COMPUTING not in status.line.content
    panel.adopt(other)
    panel.report(said["lift_box"], PACE)
    assert FAILED.line not in status.line.content


def test_what_fails_beside_a_motion_that_is_known_leaves_its_verdict(panel):
    scenario = avoiding("draw_s", SPHERE)
    panel.adopt(scenario)
    panel.report(replace(frame(certificates=HOLDING), task=TASKS["draw_s"]()), PACE)
    panel.fail(ValueError("no picture"))
    assert "✓ safe" in panel.status.line.content and "no picture" in panel.status.line.content.lower()


class Begun:
    """A session that begins what it is told to once it may."""

    def __init__(self, scenario):
        self.scenario, self.may, self.asked = scenario, threading.Event(), []
        self.panel: Any = None

    def choose_task(self, name):
        assert self.may.wait(30)
        self.asked.append(name)
        if name == "push_box":
            raise DemonstrationError("push.csv", "lines", "none", "two or more")
        self.scenario = replace(self.scenario, task=name)
        self.panel.adopt(self.scenario)


@pytest.mark.parametrize(("chosen", "settles"), [("lift_box", False), ("draw_s", True), ("push_box", True)])
def test_choosing_a_task_keeps_nobody_waiting_and_says_at_once_what_is_done(panel, chosen, settles):
    session = Begun(avoiding("draw_s", ()))
    session.panel = panel
    panel.connect(cast(Session, session))
    panel.adopt(session.scenario)
    panel.report(replace(frame(scenario=session.scenario), task=TASKS["draw_s"]()), PACE)
    settled = panel.status.details.content, panel.hint.content
    panel._begin(lambda session, name: session.choose_task(name), cast(Session, session), chosen)
    assert COMPUTING in panel.status.line.content and session.asked == []
    session.may.set()
    assert panel._beginnings.wait_idle(30)
    assert session.asked == [chosen]
    assert (COMPUTING not in panel.status.line.content) == settles
    assert ((panel.status.details.content, panel.hint.content) == settled) == settles
    assert ("push.csv" in panel.status.line.content) == (chosen == "push_box")
