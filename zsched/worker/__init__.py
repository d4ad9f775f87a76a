"""The library a Python worker imports: ``from zsched.worker import Worker``."""

from zsched.worker.outputs import Output
from zsched.worker.samples import Received
from zsched.worker.services import Answer, Request
from zsched.worker.worker import Worker

__all__ = ["Answer", "Output", "Received", "Request", "Worker"]
