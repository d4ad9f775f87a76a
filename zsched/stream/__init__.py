"""The library for a robot's application that has its streams itself: ``from zsched.stream import Streams``."""

from zsched.stream.samples import Received
from zsched.stream.streams import Publisher, Streams

__all__ = ["Publisher", "Received", "Streams"]
