"""The optional effects. Options, statistics, A/B runs, training, field.json, renders, scores and the report follow from
this list.

A new effect is its model in ``nerf/effects``, its statistic in ``nerf/effects/statistics`` and its entry here. The
order is that in which effects are decided, and applied to rays and colours.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    import numpy as np

    from nerf.effects import ColourEffect, RayEffect
    from nerf.effects.statistics.statistic import Statistic
    from stages.effects.scene_statistics import Observations


class EffectParts(NamedTuple):
    """What an effect is made of. ``statistic`` tells whether the scene calls for it; ``measured``, what it begins with,
    (training images, numbers). ``rays`` or ``colours`` is its model; neither: it is the field's own (stages/train)."""

    statistic: "Callable[[Observations], Statistic]"
    measured: "Callable[[Observations], np.ndarray] | None" = None
    rays: "type[RayEffect] | None" = None
    colours: "type[ColourEffect] | None" = None


class Effect(NamedTuple):
    """``load`` imports its parts, which need torch. ``part_of_the_method``: the published method has it, so it is left
    out only where that gains; others are added only where that does. ``has_lookalike``: something else may look
    like it, so that where its statistic is clear an A/B run may still speak against it."""

    name: str
    description: str
    load: Callable[[], EffectParts]
    part_of_the_method: bool = False
    has_lookalike: bool = False


def _background() -> EffectParts:
    from stages.effects.scene_statistics import classify_background

    return EffectParts(lambda seen: classify_background(seen.places))


def _exposure() -> EffectParts:
    from nerf.effects.exposure import ExposureModel
    from stages.effects.scene_statistics import classify_exposure, measured_gains

    return EffectParts(classify_exposure, measured_gains, colours=ExposureModel)


def _vignetting() -> EffectParts:
    from nerf.effects.statistics.vignetting import vignetting_statistic
    from nerf.effects.vignetting import VignettingModel
    from stages.effects.scene_statistics import measured_vignetting

    return EffectParts(lambda seen: vignetting_statistic(seen.darkening), measured_vignetting, colours=VignettingModel)


def _pose_refinement() -> EffectParts:
    from nerf.effects.pose_refinement import PoseRefinement
    from stages.effects.scene_statistics import classify_poses

    return EffectParts(lambda seen: classify_poses(seen.places), rays=PoseRefinement)


def _view_dependence() -> EffectParts:
    from nerf.effects.statistics.view_dependence import view_dependence_statistic

    return EffectParts(lambda seen: view_dependence_statistic(seen.tracks, seen.exposure))


EFFECTS = [
    Effect("background", "space beyond the region of interest, contracted", _background),
    Effect("exposure", "a gain per photo and colour channel", _exposure),
    # Poses before the others: there are two A/B runs, and wrong poses cost more.
    Effect("pose_refinement", "a rigid correction of each photo's camera", _pose_refinement),
    # Corners may lie in the dark: on fountain_p11 a part of what the statistic sees is light (docs/experiments).
    Effect("vignetting", "less light towards the corners of each camera", _vignetting, has_lookalike=True),
    Effect(
        "view_dependence", "colour that depends on the viewing direction", _view_dependence, part_of_the_method=True
    ),
]
