"""What a solved step is worth: momenta, energies, resultants, contact fields, impacts."""
