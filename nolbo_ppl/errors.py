"""The errors of the library: one base class, and messages that say what was got, what was expected and what to do."""

from __future__ import annotations

from os import PathLike


class NolboError(Exception):
    """Base class of every error the library raises on purpose.

    Example:
        >>> import nolbo_ppl
        >>> try:
        ...     nolbo_ppl.read_observations("no such file.jsonl")
        ... except nolbo_ppl.NolboError as error:
        ...     print(error)
        no such file.jsonl: no such file
    """


class InputError(NolboError, ValueError):
    """Input that cannot be used: the message names where it came from, what was got and what was expected.

    Example:
        >>> import nolbo_ppl
        >>> nolbo_ppl.Detections.from_arrays([0], [[1.0, 2.0]])
        Traceback (most recent call last):
        nolbo_ppl.errors.InputError: position has the wrong shape: got (1, 2), expected (1, 3)
    """


def located(error: InputError, file: str | PathLike[str]) -> InputError:
    """The same error with the file it came from before it."""
    return InputError(f"{file}: {error}")


def input_error(
    what: str,
    *,
    got: object = None,
    expected: object = None,
    do: str | None = None,
    file: str | PathLike[str] | None = None,
    line: int | None = None,
) -> InputError:
    """Build the `InputError` to raise: `file:line: what: got ..., expected ...; do`.

    Args:
        what: what is wrong, in a few words.
        got: the offending value, shortened to 200 characters in the message.
        expected: what would have been accepted.
        do: what the user should do about it.
        file: the file the value came from.
        line: its line in that file, counted from 1.
    """
    where = "" if file is None else f"{file}:" if line is None else f"{file}:{line}:"
    details = []
    if got is not None:
        text = str(got)
        details.append(f"got {text if len(text) <= 200 else text[:197] + '...'}")
    if expected is not None:
        details.append(f"expected {expected}")
    message = f"{where} {what}".strip()
    if details:
        message += ": " + ", ".join(details)
    if do is not None:
        message += f"; {do}"
    return InputError(message)
