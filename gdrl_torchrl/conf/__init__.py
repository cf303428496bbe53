"""Configurations of gdrl-train; data only."""
