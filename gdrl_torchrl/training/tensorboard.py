"""TensorBoard's curves of a run that may be resumed."""

from __future__ import annotations

from pathlib import Path

from torch.utils.tensorboard.writer import SummaryWriter
from torchrl.record.loggers.tensorboard import TensorboardLogger

from gdrl_torchrl.safe_files import own_folder


class ResumedTensorboardLogger(TensorboardLogger):
    """TorchRL's logger; what an earlier start logged after a step is no longer shown.

    Args:
        run_dir: The run directory; events are below ``tensorboard``.
        total_steps: The step that the run goes on from.
    """

    def __init__(self, run_dir: Path, total_steps: int) -> None:
        self._first_step = total_steps + 1
        super().__init__("tensorboard", log_dir=str(run_dir))

    def _create_experiment(self) -> SummaryWriter:
        folder = own_folder(Path(self.log_dir) / self.exp_name)
        return SummaryWriter(str(folder), purge_step=self._first_step)
