"""The paper's evaluation on one machine: scenario, schemes, runs, figures, and a report of every claim."""
