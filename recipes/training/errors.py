"""What ends a run in one line."""


class UserError(Exception):
    """Report a bad setting, folder or checkpoint in one line; the recipe exits with status 2."""


class DivergedError(UserError):
    """Name a loss, gradient or weight that is no finite number any more."""


class EnvironmentFault(UserError):
    """Say how an environment failed; the agent is as good as before."""
