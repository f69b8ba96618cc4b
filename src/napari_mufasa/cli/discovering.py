"""Verbs of the discovery loop: diagnose, refine."""

from __future__ import annotations

VERBS = ()
