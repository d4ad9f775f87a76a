"""The lab's robots: their applications, and what is watched of them."""
