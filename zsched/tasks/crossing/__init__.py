"""Streams that cross from one cell of a site to another: a task that gives in one cell, a task that takes in the other.

The *giver* is a worker of the cell that has the streams. It asks the other cell's *taker* to take each sample, and has
processed the sample when the taker has put it. The taker is a worker there; what it puts is an output as any other.

    python -m zsched.tasks.crossing give hall-b tls/192.0.2.31:7458 tls/192.0.2.32:7458 --file /etc/zsched/hall-b.yaml
    python -m zsched.tasks.crossing take hall-a

The guide is docs/guide/scale.md, the reasons are in docs/decisions/0112-streams-cross-by-two-tasks.md.
"""
