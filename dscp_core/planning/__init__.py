"""Plans: starts and attempts, the certificate, the panels of a figure."""
