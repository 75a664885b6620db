"""What a training run says while it is at work: its live line, and where it goes on from or changes its mind."""

from typing import TYPE_CHECKING

from stages.amounts import short_count

if TYPE_CHECKING:
    from nerf.training.schedule import StepSchedule
    from stages.train.state import Pace, RunState


def live_words(state: "RunState", pace: "Pace", left: float) -> str:
    """Step, speed, quality and the seconds left; of a run that knows its pace."""
    measured = [point["heldout_psnr"] for point in state.curve if point["heldout_psnr"] is not None]
    heldout = f" · held out {measured[-1]:.1f} dB" if measured else ""
    speed = f"{short_count(pace.rays_per_step / pace.seconds_per_step)} rays/s"
    return f"step {state.step:,} · {speed} · train {pace.psnr:.1f} dB{heldout} · {left:.0f} s left"


def going_on_words(step: int, total_steps: int, left: float | None) -> str:
    """After a kill; ``left``: seconds, where it is these that count."""
    much = f" of {total_steps:,}" if left is None else f", with {max(0.0, left):.0f} s of training left"
    return f"going on from step {step:,}{much}"


def lost_words(seconds: float) -> str | None:
    """What a kill cost; None where it is next to nothing."""
    return (
        f"{seconds:.0f} s of training after the last checkpoint are lost, and count as spent" if seconds >= 1 else None
    )


def reached_before_words(target_psnr: float) -> str:
    """That a target which a finished run has reached does not end the one that goes on from it."""
    return f"{target_psnr:g} dB are reached already: training goes on for all that was asked for"


def steering_words(state: "RunState", target_psnr: float, plan: "StepSchedule") -> str:
    """That the rate falls before the end, or goes back up, with a target in mind."""
    seen = f"{state.validation_psnr:.1f} of {target_psnr:g} dB on photos set aside after {state.step:,} steps"
    and_now = "annealing over" if plan.decisions[-1].reason == "target" else "going on for"
    return f"{seen}: {and_now} {plan.total_steps - state.step:,} more"
