"""Genetic Deep Reinforcement Learning as a kit of TorchRL components."""

import sys

if "OpenGL" in sys.modules or "glfw" in sys.modules:
    # tensordict loads Triton, which must be made ready for a Mesa that came first.
    from gdrl_tasks.engines.opengl import load_triton

    load_triton()
