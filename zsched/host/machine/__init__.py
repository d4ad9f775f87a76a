"""CPU, memory and cgroups of this machine."""
