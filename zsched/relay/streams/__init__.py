"""The streams of a task at this node: from a publisher to the owner, and back to the applications."""
