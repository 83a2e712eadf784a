"""Prints the SSIM that scikit-image gives a pair of images; tests/cli/volume_scores.rs compares it with ours."""
import numpy as np
from skimage.metrics import structural_similarity

WIDTH, HEIGHT = 37, 23
y, x = np.mgrid[:HEIGHT, :WIDTH].astype(float)
truth = (x * x + 3 * x * y + 40 * y) % 97 / 97 * 0.5 + 0.5 * x / WIDTH
prediction = 0.8 * truth + (7 * x + 11 * y) % 13 / 13 * 0.2
# The settings of Wang et al. 2004; scikit-image, too, leaves out pixels whose window leaves the image.
value = structural_similarity(
    truth, prediction, data_range=1.0, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
)
print(repr(float(value)))
