"""Every node of a fleet file on one machine, for somebody who writes a task: real daemons, addresses of their own."""
