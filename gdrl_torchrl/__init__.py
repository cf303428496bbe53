"""Genetic Deep Reinforcement Learning as a kit of TorchRL components."""
