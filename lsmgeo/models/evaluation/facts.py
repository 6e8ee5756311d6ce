"""What a reader of a report must know of how it came about."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from lsmgeo.models.evaluation.contenders import Contender
from lsmgeo.models.evaluation.options import Options
from lsmgeo.models.evaluation.shapes import Shapes

__all__ = ["facts_of"]


def facts_of(contenders: Sequence[Contender], shapes: Shapes, options: Options, **settings: Any) -> dict[str, Any]:
    """The data, the models and the settings of a report, as JSON can hold them.

    Args:
        contenders: the models.
        shapes: what was evaluated on.
        options: the seed.
        settings: what else the figures depend on.
    """
    return {
        "data": shapes.about,
        "models": [
            {
                "name": contender.name,
                "network": contender.kind,
                "path": contender.path,
                "trained on": contender.training.words or "all categories, white",
                "parameters": sum(parameter.numel() for parameter in contender.model.parameters()),
            }
            for contender in contenders
        ],
        "seed": options.seed,
        **settings,
    }
