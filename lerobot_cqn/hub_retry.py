"""Failures between this machine and the Hub, and whether another try may go better."""

import time
from collections.abc import Callable, Sequence
from typing import Any

import httpx
from huggingface_hub import constants, get_token
from huggingface_hub.errors import HfHubHTTPError

from .errors import CQNError

__all__ = ["PASSING", "HubError", "cause", "passing", "refuse_to_start", "retried", "said", "transport"]

pause = time.sleep

PASSING = (408, 429, 500, 502, 503, 504)  # answers that may be another one later


class HubError(CQNError):
    """The Hub refused or could not be reached; the message ends with the command that goes on."""


def refuse_to_start() -> None:
    """Make sure that the Hub may be asked at all.

    Raises:
        HubError: offline mode is on, or nobody is logged in.
    """
    if constants.is_offline_mode():
        raise HubError(
            "HF_HUB_OFFLINE (or TRANSFORMERS_OFFLINE) is set, which forbids any connection; unset it and push again,"
            " or look at what would be sent with --dry_run."
        )
    if not get_token():
        raise HubError(
            "Nobody is logged in to the Hub: run `hf auth login` with a token that may write, or set HF_TOKEN."
        )


def retried(
    call: Callable[[], Any],
    waits: Sequence[float],
    explained: Callable[[BaseException], CQNError],
    say: Callable[[str], None],
) -> Any:
    """Result of a call to the Hub, made again where that may help.

    Args:
        call: raises whatever the Hub's client, its transport and its encoder raise.
        waits: seconds before each further try.
        explained: what is raised in place of the last failure, made from its cause.
        say: tells a person of a failure that passes.
    """
    for wait in (*waits, None):
        try:
            return call()
        except CQNError:
            raise
        except Exception as error:  # they raise kinds of their own
            behind = cause(error)
            reason = passing(behind)
            if reason is None or wait is None:
                raise explained(behind) from error
            say(f"{reason}; trying again in {wait:g} s.")
            pause(wait)
    raise AssertionError


def cause(error: BaseException) -> BaseException:
    """The error behind the client's 'Error while uploading'."""
    return error.__cause__ if type(error) is RuntimeError and error.__cause__ is not None else error


def passing(error: BaseException) -> str | None:
    """A phrase on what happened, where another try may go better; else None."""
    if isinstance(error, HfHubHTTPError):
        status = error.response.status_code
        return f"The Hub answered {status}" if status in PASSING else None
    return f"The connection failed ({said(error)})" if transport(error) else None


def transport(error: BaseException) -> bool:
    """Whether the network failed; the Xet client has plain errors for that, and for a refusal (4xx) as well."""
    if "client error" in str(error):
        return False
    plain = type(error) in (RuntimeError, OSError) and not getattr(error, "filename", None)
    return plain or isinstance(error, httpx.TransportError | ConnectionError | TimeoutError)


def said(error: BaseException) -> str:
    """One line without addresses, which may hold signatures."""
    text = error.server_message if isinstance(error, HfHubHTTPError) and error.server_message else str(error)
    words = [w for w in text.split() if "://" not in w]
    return " ".join(words)[:200].rstrip(" .:;") or type(error).__name__
