"""The services of a task at this node: requests to the owner, and their answers."""
