"""The first hour of somebody who has never run zsched, played in a clean machine."""
