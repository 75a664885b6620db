"""The wall time that a run in a workspace may take: which stage costs time of it now, and what each is given."""

from collections.abc import Mapping

from pipeline.engine.display import Display
from pipeline.engine.run_digests import RunDigests
from pipeline.engine.run_file import RunFile
from pipeline.engine.workspace import Workspace
from pipeline.schedule.budget import RUNNING, Account, Stages, Times
from pipeline.schedule.forecast import Left
from stages.contract import StageConfig


class RunBudget:
    """The budget of a run, in run.json; without one (``account`` is None) nothing here does anything."""

    def __init__(
        self,
        workspace: Workspace,
        run_file: RunFile,
        digests: RunDigests,
        stages: Stages,
        options: Mapping[str, StageConfig],
    ) -> None:
        self.workspace, self.run_file, self.digests = workspace, run_file, digests
        self.stages, self.options = stages, options
        self.charged = False  # whether any work of this program has cost time of the budget
        self._apart: Account | None = None  # of a stage alone, after a whole run that has its own
        self._working: str | None = None

    @property
    def account(self) -> Account | None:
        """The time that the run may take in all, and what it has taken, where there is a limit."""
        return self._apart or self.run_file.budget

    def set_total(self, total: float | None, before: float) -> None:
        """Make ``total`` seconds the budget of the workspace, None for no limit. The same as before goes on.

        ``before``: seconds spent already on what the photos were made in.
        """
        if total is None:
            self.run_file.budget = None
        elif self.account is None or self.account.total != total:
            self.run_file.budget = Account(total=total, run=self.digests.of_options())
            if before:
                self.run_file.budget.end("photos", before)

    def left(self) -> Left | None:
        """The total, and what of it this run has: all, unless it goes on with an interrupted one."""
        if (account := self.account) is None:
            return None
        account.recover(self.workspace.root)
        goes_on = account.seconds_spent and account.is_of(self.digests.of_options(), self.digests.of_photos())
        return Left(account.total, account.left if goes_on else account.total)

    def open(self, whole_run: bool) -> None:
        """A run begins; one stage alone does not go on with the account of a run that is over."""
        if account := self.account:
            account.recover(self.workspace.root)
            if account.over and not whole_run:
                self._apart = Account(total=account.total, run=self.digests.of_options())

    def close(self, whole_run: bool) -> None:
        """A run that ended by itself, well or not, is over; one stage of an interrupted run does not end it."""
        if self.account and whole_run:
            self.account.over = True
            self.workspace.write_run(self.run_file)

    def begin(self, stage: str, expected: float | None) -> None:
        """From here on ``stage`` costs time of the budget, which nothing does that was found finished."""
        account = self.account
        if account is None or self._working == stage or self._is_exempt(stage):
            return
        if self.stages[stage].summary and account.over:  # it shows that account
            return
        self._working, self.charged = stage, True
        account.continue_as(self.digests.of_options(), self.digests.of_photos())
        (self.workspace.root / RUNNING).unlink(missing_ok=True)
        account.running = stage
        if expected is not None:
            account.allocate(stage, expected)
        self.workspace.write_run(self.run_file)

    def end(self, stage: str, seconds: float) -> None:
        """Note what ``stage`` cost, where it did."""
        if self.account and self._working == stage:
            self.account.end(stage, seconds)
            self._working = None
            self.workspace.write_run(self.run_file)

    def give(self, stage: str, after: Times, reading: float, display: Display) -> float:
        """The option ``seconds`` of ``stage``. ``after``: the stages after it, with the seconds they are expected to
        take; ``reading``: what it takes to read the photos. Says where the budget is too short for all of them."""
        assert self.account, "there is no limit to share out"
        to_come = {name: seconds for name, seconds in after.items() if not self._is_exempt(name)}
        main = (how := self.stages[stage].flexible) is not None and how.max_share >= 1
        if main and (why := self.account.shortage(self.stages, {stage: None, **to_come}, reading)):
            display.note("pipeline.budget-exceeded", f"the budget is too short: {why}")
        return self.account.give(self.stages, stage, to_come, reading)

    def _is_exempt(self, stage: str) -> bool:
        return self.stages[stage].is_exempt(self.options[stage])
