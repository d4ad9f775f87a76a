"""Shows a running fleet over time: a full screen, a page for browsers, a recording, each a process of its own."""
