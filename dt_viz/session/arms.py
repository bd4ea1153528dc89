"""Arms that visitors choose from, with the tasks in their reach, and the engines of one visitor."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping

from dt_viz.learning.imitation import Progress
from dt_viz.learning.store import FitStore
from dt_viz.memo import Memo
from dt_viz.robot.making import load_aside
from dt_viz.robot.models import ARMS, NUM_LOADED, local_descriptions
from dt_viz.robot.robot import Robot
from dt_viz.scenario.tasks import TaskEntry
from dt_viz.session.engine import Engine
from dt_viz.session.tasks_in_reach import in_reach

NewEngine = Callable[[str, Progress], Engine]
"""Makes an engine for the arm of a name, loaded with progress."""


_Workplace = tuple[Robot, Mapping[str, TaskEntry], Memo]
"""An arm, the tasks in its reach, by name, and what all engines for it share."""


class ArmStore:
    """Arms on demand, once for all visitors; those used last are kept beside those that visitors have.

    The first one, that of the server, has an empty name.
    """

    def __init__(self, tasks: Mapping[str, TaskEntry], fits: FitStore, first: Robot) -> None:
        """Take tasks made for the JACO, by name, what was learned before, and the arm that visitors begin with."""
        self._tasks, self._fits, self._memo = tasks, fits, Memo()
        self._first: _Workplace = first, in_reach(tasks, first), Memo()
        known = {name: name for name in local_descriptions()} | {name: arm.title for name, arm in ARMS.items()}
        others = {name: title for name, title in known.items() if (name, title) != (first.name, first.title)}
        self.titles = {"": first.title + " (given)" * (first.title in others.values()), **others}
        """Titles of the arms that may be chosen, by their names."""

    def engine(self, name: str = "", progress: Progress = lambda _fraction, _message: None) -> Engine:
        """Make an engine for an arm of `titles`; `progress` is told how much of it is loaded, and may raise to cancel.

        Raises:
            ArmError: its description cannot be used.
            FileNotFoundError: a file of it is gone.
        """

        def load() -> _Workplace:
            robot = load_aside(name, progress)
            return robot, in_reach(self._tasks, robot, moves_recorded=True), Memo()

        robot, tasks, shared = self._memo("arm", name, load, newest=NUM_LOADED) if name else self._first
        return Engine(tasks, self._fits, robot, shared, name)


class Engines:
    """The engines of one visitor, one for each arm: the two that were used last."""

    def __init__(self, first: Engine, new: NewEngine | None) -> None:
        """Begin with an engine for the first arm; `new` makes others, None if there are none."""
        self._new = new or (lambda _name, _progress: first)
        self._lock, self._known = threading.Lock(), {"": first}
        self.deleted = set[str]()
        """Names of the visitor's own tasks that are not in the list of tasks any more."""

    def get(self, arm: str) -> Engine | None:
        """The engine for an arm, if that is there at once."""
        return self._known.get(arm)

    def __call__(self, arm: str, progress: Progress = lambda _fraction, _message: None) -> Engine:
        """The engine for an arm; raises as `ArmStore.engine`."""
        engine = self.get(arm) or self._new(arm, progress)
        with self._lock:
            if arm in self._known:
                engine = self._known[arm]  # the first of two that were made at once
            else:
                engine.own = next(iter(self._known.values())).own
            others = [(name, known) for name, known in self._known.items() if name != arm]
            self._known = dict([*others[-1:], (arm, engine)])
        return engine
