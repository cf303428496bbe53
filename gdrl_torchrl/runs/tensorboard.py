"""TensorBoard's curves of a run that may be resumed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from PIL import Image
from tensorboard.compat.proto.summary_pb2 import Summary  # pyright: ignore
from torch.utils.tensorboard.writer import SummaryWriter
from torchrl.record.loggers.tensorboard import TensorboardLogger

from gdrl_torchrl.files.safe_files import own_folder


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

    def log_metrics(
        self, metrics: Mapping[str, Any], step: int | None = None, **options: Any
    ) -> dict[str, Any]:
        """Log numbers by name, all in one record: one each takes ten times as long."""
        values = [Summary.Value(tag=n, simple_value=float(x)) for n, x in metrics.items()]
        self._add(values, step)
        return dict(metrics)

    def log_configuration(self, config: Mapping[str, Any], step: int) -> None:
        """Show a configuration under TensorBoard's texts."""
        text = json.dumps(config, indent=2).replace("\n", "\n    ")
        self.experiment.add_text("configuration", f"    {text}", step)

    def log_picture(self, name: str, path: Path, step: int) -> None:
        """Show a file in PNG as it is."""
        with Image.open(path) as picture:
            width, height = picture.size
        image = Summary.Image(
            height=height,
            width=width,
            colorspace=4,
            encoded_image_string=path.read_bytes(),
        )
        self._add([Summary.Value(tag=name, image=image)], step)

    def _add(self, values: list[Summary.Value], step: int | None) -> None:
        writer: Any = self.experiment.file_writer
        writer.add_summary(Summary(value=values), step)
