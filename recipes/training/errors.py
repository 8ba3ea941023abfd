"""The error that a person running a recipe can mend."""

from __future__ import annotations


class UserError(Exception):
    """Report a bad setting, folder or checkpoint in one line; the recipe exits with status 2."""
