"""TactileSRCNN, the predecessor of the paper's network, with one tap and no force branch.

Source: Wu, Liu and Zhang 2022 ([20] of Wu and Liu 2024). Parameters (4.36 M) and MACs (6.96 G at 40 x 40) of the later
paper's table are those of three 3 x 3 convolutions, six multi-scale blocks and a last convolution; the 2022 code has a
single convolution before the blocks, which would be 4.29 M.
"""

from torch import Tensor, nn

from train.networks.blocks import MultiScaleResidual, PatternNet, initialise, normed_conv, to_pattern, upsample
from train.networks.wu_liu_2024 import BLOCKS, CHANNELS


class TactileSRCNN(PatternNet):
    """Network from a window of one tap to a pattern, with batch normalisation throughout.

    Args:
        scale: pattern pixels per taxel pitch.

    Raises:
        ValueError: scale is not positive.
    """

    def __init__(self, scale: int) -> None:
        super().__init__()
        if scale < 1:
            raise ValueError(f"scale is {scale}, expected at least 1")
        self.taps, self.scale = 1, scale
        self.net = nn.Sequential(
            normed_conv(3, CHANNELS, 3),
            normed_conv(CHANNELS, CHANNELS, 3),
            normed_conv(CHANNELS, CHANNELS, 3),
            *(MultiScaleResidual(CHANNELS) for _ in range(BLOCKS)),
            nn.Conv2d(CHANNELS, 1, 3, padding=1, bias=False),
        )
        initialise(self)

    def forward(self, window: Tensor) -> Tensor:
        """Return patterns (n, H, W) in [mm] of windows (n, 3, rows, cols) in network units."""
        return to_pattern(self.net(upsample(window, self.scale)), training=self.training)
