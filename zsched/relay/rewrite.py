"""Decides under which key a sample goes on: `zsched.core.capture` under the relay's own name.

Knows: nothing of its own. Does not know: zenoh, streams, who asks.
"""

from zsched.core.capture import Rewriter, rewriter

__all__ = ["Rewriter", "rewriter"]
