"""Tests that wrong use is refused: an error whose one line says what is wrong."""

import pytest


def refuses(*cases, make=None):
    """Return the test that each use is refused with its line.

    A case is a use and a part of the line, with the error between them where it is no ValueError;
    a use is a function without arguments or the keywords of `make`.
    """
    full = [(use, *(error or [ValueError]), line) for use, *error, line in cases]

    @pytest.mark.parametrize(("use", "error", "line"), full)
    def test(use, error, line):
        with pytest.raises(error, match=line) as caught:
            use() if callable(use) else make(**use)
        assert "\n" not in str(caught.value)

    return test
