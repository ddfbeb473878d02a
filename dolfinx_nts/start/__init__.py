"""What a run or an equilibrium begins with: consistent velocities, first contact forces."""
