"""A history that no order explains, and a machine of Hypothesis that finds the crash behind such a history."""

import hypothesis.strategies as st
from hypothesis import Phase, settings
from hypothesis.stateful import rule, run_state_machine_as_test

import holdfast as hf
from holdfast.testing import ActorMachine, History, Model, NotLinearizable, linearizable


class Deposit(hf.Message[int]):
    amount: int


class Account(hf.Actor):
    def __init__(self) -> None:
        self.balance = 0

    @hf.on(Deposit)
    def deposit(self, message: Deposit) -> int:
        self.balance += message.amount
        return self.balance


def account(balance: int, message: Deposit) -> tuple[int, int]:
    return balance + message.amount, balance + message.amount


class Forgetful(ActorMachine):
    """The account has no recovery: what was deposited before a crash is lost."""

    model = Model(0, account)

    def set_up(self) -> None:
        self.account = self.start(hf.child("account", hf.start(Account)))

    @rule(amount=st.integers(1, 9))
    def deposit(self, amount: int) -> None:
        self.ask(self.account, Deposit(amount))

    @rule()
    def crash(self) -> None:
        self.crash_actor(self.account)


class Durable(Forgetful):
    """The same account, with recovery."""

    def set_up(self) -> None:
        self.account = self.start(hf.child("account", hf.start(Account), recovery=hf.hybrid()))


def main() -> None:
    history = History()
    history.end(history.begin("one", Deposit(5)), 5)
    history.end(history.begin("other", Deposit(1)), 1)
    print(bool(linearizable(history, Model(0, account))))  # False

    phases = [Phase.generate, Phase.shrink]
    chosen = settings(max_examples=50, stateful_step_count=8, deadline=None, derandomize=True, phases=phases)
    run_state_machine_as_test(Durable, settings=chosen)
    try:
        run_state_machine_as_test(Forgetful, settings=chosen)
    except NotLinearizable as error:
        print(str(error).split(":")[0])  # the history is not linearizable


if __name__ == "__main__":
    main()
