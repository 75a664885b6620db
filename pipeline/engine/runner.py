"""Runs stages: finds what is already there, plans what was left open, runs the rest, finishes it durably."""

import shutil
import time
from collections.abc import Collection, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pipeline.engine import machine, manifest_file
from pipeline.engine.cache_keys import digest, stage_key
from pipeline.engine.display import Display
from pipeline.engine.failures import StageFailed, recorded, worded
from pipeline.engine.job import DamagedInputs, Job, NotReady
from pipeline.engine.manifest_file import BadManifest, Manifest
from pipeline.engine.run_budget import RunBudget
from pipeline.engine.run_digests import RunDigests
from pipeline.engine.settings import Settings
from pipeline.engine.stage_list import SOURCE, STAGES, command_that_makes, needed_for
from pipeline.engine.workspace import Workspace
from pipeline.schedule.budget import RUNNING
from pipeline.schedule.forecast import Forecast, forecast_run, limited_seconds, photos_of, time_behind_plan
from stages.contract import StageConfig, StageError, Workload, plan_stage, reading_seconds
from stages.hardware.device import processors
from stages.io.photos import read_photos
from stages.io.stopwatch import counting, elapsed, write_elapsed

ATTEMPTS = "attempts.json"  # in a partial folder: seconds of all attempts at the stage, planning included


class Runner:
    """Brings stages of one workspace up to date. The workspace's lock must be held by whoever calls ``run``."""

    def __init__(self, workspace: Workspace, settings: Settings, display: Display) -> None:
        self.workspace, self.settings, self.display = workspace, settings, display
        self.force: frozenset[str] = frozenset()
        self.run_file = workspace.read_run()
        self.run_file.options = settings.model_dump(mode="json")
        self.digests = RunDigests(workspace, self.run_file, STAGES, self.options[SOURCE], display)
        self.budget = RunBudget(workspace, self.run_file, self.digests, STAGES, self.options)
        self.done: dict[str, Manifest] = {}
        self.stages: list[str] = []
        self.times: Mapping[str, float | None] = {}
        self.planning: dict[str, float] = {}  # seconds that it took, where it was done by this program
        self.started: dict[str, float] = {}  # when each stage did, later by what an input cost that was rebuilt
        self.checked: set[str] = set()  # stages whose files were written or read anew by this program
        self.running = ""
        self.verify = False

    @property
    def options(self) -> dict[str, Any]:
        """The options of each stage, as the user gave them."""
        return {stage: getattr(self.settings, stage) for stage in STAGES}

    def _inputs(self, stage: str) -> tuple[str, ...]:
        """The stages that ``stage`` reads under the options of this run."""
        return STAGES[stage].inputs_of(self.options[stage])

    def forecast(self, stages: Sequence[str], again: Collection[str]) -> Forecast:
        """How long a run of ``stages`` takes, ``again`` those of them that may run though they have a result. Nothing
        where the photos or a file that a setting names cannot be read: the stage that reads it says so."""
        try:
            to_run = [name for name in stages if name in again or self.found(name) is None]
            if all(STAGES[name].summary for name in to_run):
                return Forecast([], {})
            photos = photos_of(self.options[SOURCE])
            if photos is None:
                return Forecast([], {})

            def facts(stage: str, key: str | None) -> Mapping[str, Any] | None:
                if key is None:
                    finished = None if stage in to_run else self.found(stage)
                    return finished and finished.facts
                try:
                    return manifest_file.read(self.workspace.folder(stage, key)).facts
                except (FileNotFoundError, BadManifest):
                    return None

            def partial(stage: str) -> Path | None:
                return None if stage in again else self._resumed(stage)

            workload = Workload(photos, processors(), self.options, facts, partial)
            return forecast_run(STAGES, to_run, workload, self.budget.left())
        except StageError:
            return Forecast([], {})

    def found(self, stage: str) -> Manifest | None:
        """The finished result of ``stage`` for these options, as far as can be told beforehand; None without one."""
        try:
            return self._upstream(stage, needed=False) if self.run_file.keys else None
        finally:
            self.done.clear()  # what runs now may make it outdated

    def _resumed(self, stage: str) -> Path | None:
        """The folder that an interrupted attempt at ``stage`` left to go on from, as far as can be told beforehand."""
        try:
            if not STAGES[stage].resumes or not self.run_file.keys:
                return None
            folder = self.workspace.partial(stage, self.resolve(stage, may_plan=False).key)
            return folder if folder.is_dir() else None
        except NotReady:
            return None
        finally:
            self.done.clear()

    def run(
        self,
        stages: Sequence[str],
        *,
        force: frozenset[str] = frozenset(),
        replan: Collection[str] = (),
        remember: bool = True,
        times: Mapping[str, float | None] | None = None,
        verify: bool = False,
    ) -> bool:
        """Bring ``stages`` (in chain order) up to date; True if anything ran. Raises StageFailed.

        ``force`` names stages that run again even where a finished result exists; ``replan`` those of which is
        forgotten what was chosen for the user before; ``remember`` makes ``stages`` what `pipeline resume` repeats;
        ``times`` are the seconds that stages are expected to take (:meth:`forecast`), for a budget and the
        report; ``verify`` reads every file of a finished result before it counts as finished. A stage that fails ends
        the run, unless all later ones can go without it: then it is raised when these are done.
        """
        self.verify, self.force, self.stages, self.times = verify, force, list(stages), times or {}
        self.budget.open(whole_run=remember)
        for stage in replan:
            self.run_file.plans.pop(stage, None)
        if remember:
            self.run_file.stages = list(stages)
        self.workspace.write_run(self.run_file)
        failures: list[StageFailed] = []
        try:
            ran = [self._attempted(stage, failures) for stage in stages]
        except Exception as problem:
            self._unlink_outdated()
            if isinstance(problem, StageFailed):
                self.budget.close(whole_run=remember)
            raise
        except BaseException:  # a signal: whoever sent it does not wait for photos to be read
            self._unlink_after(self.running)
            raise
        self._unlink_outdated()
        self.budget.close(whole_run=remember)
        if failures:
            raise failures[0]
        return any(ran)

    def _attempted(self, stage: str, failures: list[StageFailed]) -> bool:
        """Bring ``stage`` up to date; True if anything ran. Its failure joins ``failures`` where the run goes on."""
        try:
            return self._bring_up_to_date(stage)
        except StageFailed as failure:
            error = failure.error
            if failures:  # the first decides how the run ends
                self.display.note("pipeline.failed-too", f"failed, too: {error.what}: {error.why}")
                raise failures[0] from failure
            if failure.stage != stage or not self._can_go_without(stage):
                raise
            failures.append(failure)
            self.running = ""
            self.display.note("pipeline.goes-on", f"failed: {error.what}; the run continues without it")
            return True

    def _can_go_without(self, stage: str) -> bool:
        """Whether later stages of this run read the result of ``stage``, and none of them needs it."""
        later = self.stages[self.stages.index(stage) + 1 :]
        readers = [name for name in later if stage in self._inputs(name) and not STAGES[name].summary]
        return bool(readers) and all(stage in STAGES[name].dispensable for name in readers)

    def _unlink_outdated(self) -> None:
        """Take out of ``output/`` what belongs to other settings than the current ones."""
        for name, stage in STAGES.items():
            try:
                self._upstream(name)
            except NotReady:
                self.workspace.unlink_outputs(stage.published)
            except StageError:  # photos or a file that a setting names cannot be read: said where that stage runs
                continue

    def _unlink_after(self, stage: str) -> None:
        """Take out of ``output/`` what rests on ``stage``, which was running; nothing where none was."""
        for name, later in STAGES.items():
            if stage and (later.summary or stage in needed_for(name, self.options, STAGES)):
                self.workspace.unlink_outputs(later.published)

    def _bring_up_to_date(self, stage: str) -> bool:
        self.started[stage] = time.monotonic()
        self.display.begin(stage)
        try:
            with worded(STAGES[stage]):
                job, manifest, ran = self._found_or_made(stage)
                self.workspace.link_outputs(self.workspace.folder(stage, job.key), job.stage.published)
                self.workspace.write_run(self.run_file)
                self.digests.index.save()
        finally:
            self.budget.end(stage, time.monotonic() - self.started[stage])
        self.done[stage] = manifest
        self.display.end(stage, manifest.line, time.monotonic() - self.started[stage], cached=not ran)
        return ran

    def _found_or_made(self, stage: str) -> tuple[Job, Manifest, bool]:
        """The stage's job and result, and whether it had to run for it."""
        try:
            job = self.resolve(stage)
            self.run_file.keys[stage] = job.key
            manifest = None if stage in self.force else self.find_finished(job)
            if manifest is not None:
                return job, manifest, False
            self._check_inputs(stage, job.folders)
        except DamagedInputs:
            self._rebuild_inputs(stage)
            return self._found_or_made(stage)
        self.workspace.unlink_outputs(job.stage.published)
        return job, self._execute(job), True

    def _check_inputs(self, stage: str, folders: dict[str, Path]) -> None:
        """Compare all that ``stage`` is to read with its sha256. Raises DamagedInputs after quarantining
        what is damaged. An optional input stays in place and leaves ``folders``: nobody rebuilds that here.

        Once per program and stage: what this program wrote itself was hashed when it was written.
        """
        damaged = False
        for name in [name for name in folders if name not in self.checked]:
            self.display.update(f"checking the files of {name}")
            needed = name in self._inputs(stage)
            try:
                if needed:
                    self.workspace.finished(name, self.done[name].key, deep=True)
                else:
                    manifest_file.check_outputs(folders[name], self.done[name], deep=True)
                self.checked.add(name)
            except BadManifest as problem:
                damaged = damaged or needed
                if needed:
                    self.display.note("pipeline.quarantined-input", f"quarantined as .bad and rebuilt: {problem}")
                else:
                    del folders[name]
                    command = command_that_makes(name, self.run_file.stages, self.workspace.root)
                    rebuild = f"`{command} --verify` rebuilds it ({problem})"
                    self.display.note("pipeline.damaged-input", f"{name} is damaged and left out; {rebuild}")
        if damaged:
            raise DamagedInputs

    def _rebuild_inputs(self, stage: str) -> None:
        """Bring everything below ``stage`` up to date once more; what lies above the damage may change with it."""
        above = [name for name in self._inputs(stage) if name in self.done]
        needed = {name for one in above for name in needed_for(one, self.options, STAGES)}
        clock = time.monotonic()
        self.done.clear()
        self.digests.forget_photos()
        for name in STAGES:
            if name in needed:
                self._bring_up_to_date(name)
        self.started[stage] += time.monotonic() - clock  # each has its own account
        self.display.begin(stage)

    def resolve(self, stage: str, *, may_plan: bool = True) -> Job:
        """Everything that decides ``stage``'s key.

        Raises NotReady where an upstream result is missing, or where settings are left open and may not be planned.
        """
        declared, read = STAGES[stage], self._inputs(stage)
        needed = () if declared.summary else {*read} - {*declared.dispensable}
        upstream = {name: m for name in read if (m := self._upstream(name, name in needed)) is not None}
        names = declared.optional_inputs
        optional = {name: m for name in names if (m := self._upstream(name, needed=False)) is not None}
        folders = {name: self.workspace.folder(name, m.key) for name, m in (upstream | optional).items()}
        # A summary shows timings and logs too, so it depends on whole manifests and not only on outputs.
        if declared.summary:
            inputs = {name: manifest_file.file_sha256(folders[name] / manifest_file.NAME) for name in upstream}
        else:
            inputs = {name: m.outputs_digest for name, m in upstream.items()}
        config = self._planned(stage, inputs, folders, may_plan)
        key_config = self.digests.config_for_key(stage, config)
        key = stage_key(stage, declared.version, key_config, inputs)
        return Job(declared, config, key_config, inputs, folders, key)

    def _upstream(self, name: str, needed: bool = True) -> Manifest | None:
        """The current result of ``name``; where it is not ``needed`` None without one, else NotReady is raised."""
        if name not in self.done:
            try:
                key = self.resolve(name, may_plan=False).key
                self.done[name] = manifest_file.read(self.workspace.folder(name, key))
            except (NotReady, FileNotFoundError, BadManifest):
                if needed:
                    raise NotReady(name) from None
            except StageError:  # a file that a setting names is gone: the stage says so where it runs
                rests_on_it = (name in self._inputs(later) for later in STAGES if not STAGES[later].summary)
                if needed or any(rests_on_it):
                    raise
        return self.done.get(name)

    def _planned(self, stage: str, inputs: dict[str, str], folders: dict[str, Path], may_plan: bool) -> StageConfig:
        """The stage's config with every "choose for me" answered: from run.json, or by its plan."""
        declared, options = STAGES[stage], self.options[stage]
        if declared.summary:
            account = self.run_file.budget
            known = {"budget": account and account.shown(STAGES), "resumed": self.run_file.stages}
            return declared.config.model_validate(options.model_dump() | known)
        if declared.plan is None:
            return options
        options_for_key = self.digests.config_for_key(stage, options)
        account = self.budget.account
        time_given = time_behind_plan(declared, self.options, account and account.total)
        asked = digest({"version": declared.version, "options": options_for_key, "inputs": inputs} | time_given)
        plans = self.run_file.plans.setdefault(stage, {})
        if asked in plans:
            # Taken as given now: paths, for the plan was made for equal content, wherever that lay then, and what is
            # part of no key. But seconds stay: where they are open, a budget gave the plan its own.
            now = {name for name, value in options if isinstance(value, Path)}
            now |= {*declared.not_hashed} - {"seconds"}
            return declared.config.model_validate(plans[asked] | options.model_dump(include=now))
        if not may_plan:
            raise NotReady(stage, asked)
        self._check_inputs(stage, folders)
        self.budget.begin(stage, self.times.get(stage))
        clock, unplanned = time.monotonic(), self.workspace.partial(stage, asked)
        with recorded(STAGES[stage], unplanned), counting(self.workspace.root / RUNNING):
            config = plan_stage(declared, self._with_time(stage, options), folders, self.display)
        shutil.rmtree(unplanned, ignore_errors=True)
        self.planning[stage] = time.monotonic() - clock
        plans[asked] = config.model_dump(mode="json")
        self.workspace.write_run(self.run_file)
        return config

    def _with_time(self, stage: str, options: StageConfig) -> StageConfig:
        """``options`` with the seconds that the run leaves for the stage, where these are open."""
        declared = STAGES[stage]
        if not options.time_is_open or not declared.has_share:
            return options
        photos = read_photos(self.workspace.folder(SOURCE, self.done[SOURCE].key))
        reading = reading_seconds(sum(photo.width * photo.height for photo in photos) / 1e6, processors())
        if self.budget.account is None:
            seconds = limited_seconds(declared, self.options, self.times, reading)
        else:
            # An input that has to be rebuilt is none of the stages that were asked for.
            order = list(STAGES)
            after = [name for name in self.stages if order.index(name) > order.index(stage)]
            times = {name: self.times.get(name) for name in after}
            seconds = self.budget.give(stage, times, reading, self.display)
        return options.model_copy(update={"seconds": seconds})

    def find_finished(self, job: Job) -> Manifest | None:
        """The finished result for this job, if there is one; a damaged one is quarantined and said aloud."""
        try:
            manifest = self.workspace.finished(job.stage.name, job.key, deep=self.verify)
            if manifest is not None and self.verify:
                self.checked.add(job.stage.name)
            return manifest
        except BadManifest as problem:
            self.display.note("pipeline.quarantined", f"quarantined as .bad and rebuilt: {problem}")
            return None

    def _execute(self, job: Job) -> Manifest:
        import stages.sfm.colmap  # noqa: F401 -- pycolmap changes how signals are handled: before ours are set

        name, stage = job.stage.name, job.stage
        partial, folder = self.workspace.partial(name, job.key), self.workspace.folder(name, job.key)
        if name not in self.force and (manifest := self.workspace.complete(partial, folder, job.key)):
            return manifest
        self.budget.begin(name, self.times.get(name))
        before = elapsed(partial / ATTEMPTS) + self.planning.pop(name, 0.0)
        if partial.exists() and not (stage.resumes and name not in self.force):
            shutil.rmtree(partial)
        partial.mkdir(parents=True, exist_ok=True)
        write_elapsed(partial / ATTEMPTS, before)
        self.workspace.write_run(self.run_file)
        started = datetime.now(UTC)
        self.running = name
        with recorded(stage, partial), counting(self.workspace.root / RUNNING), counting(partial / ATTEMPTS) as spent:
            result = stage.run(job.config, job.folders, partial, self.display)
        outputs = manifest_file.describe_outputs(partial, result.outputs)
        manifest = Manifest(
            stage=name,
            version=stage.version,
            key=job.key,
            config=job.config.model_dump(mode="json"),
            inputs=job.inputs,
            outputs=outputs,
            outputs_digest=manifest_file.outputs_digest(outputs),
            records=manifest_file.describe_outputs(partial, result.records),
            facts=result.facts,
            line=result.line,
            seconds=round(spent(), 3),
            expected=None if (expected := self.times.get(name)) is None else round(expected, 1),
            started=started.isoformat(timespec="seconds"),
            machine=machine.facts(),
        )
        self.workspace.finish(partial, folder, manifest)
        self.checked.add(name)
        self.force -= {name}
        self.running = ""
        return manifest
