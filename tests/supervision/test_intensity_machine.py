"""The restart window over a long life, against a model that forgets nothing."""

import hypothesis.strategies as st
from hypothesis import settings
from hypothesis.stateful import RuleBasedStateMachine, rule

from holdfast.supervision.intensity import admit_restart


class Window(RuleBasedStateMachine):
    def __init__(self) -> None:
        super().__init__()
        self.now = 0
        self.history: tuple[float, ...] = ()
        self.window: tuple[float, ...] = ()

    @rule(seconds=st.integers(0, 10))
    def crash_after(self, seconds: int) -> None:
        self.now += seconds
        self.history += (self.now,)  # the model: it forgets nothing
        self.window = admit_restart(self.window, self.now, intensity=3, period=5.0) or ()
        assert bool(self.window) == (sum(self.now - t <= 5.0 for t in self.history) <= 3)
        if not self.window:  # The supervisor gave up; its parent starts a new one.
            self.history = ()


TestWindow = Window.TestCase
TestWindow.settings = settings(max_examples=50, stateful_step_count=30)
