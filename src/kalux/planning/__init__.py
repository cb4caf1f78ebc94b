"""Plans of reconstructions: what a recording is mended by, what is measured of its sensor, which images are made."""

from __future__ import annotations

from kalux.planning.event_steps import ESTIMATED_ORIGINS, UNCERTAIN_ORIGINS
from kalux.planning.plans import Plan, plan

__all__ = ["ESTIMATED_ORIGINS", "UNCERTAIN_ORIGINS", "Plan", "plan"]
