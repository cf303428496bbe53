"""Read what a run left in its directory; nothing in it is run as code."""

from __future__ import annotations
