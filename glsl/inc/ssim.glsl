// Window of SSIM: a Gaussian with a standard deviation of 1.5 pixels and a length of 11 pixels; images are zero outside.
const int SSIM_REACH = 5;
const float SSIM_WINDOW[6] =
    float[6](0.2660117249, 0.2130055377, 0.1093606895, 0.0360007721, 0.0075987581, 0.0010283801);

// Constants of SSIM for images with values from 0 to 1.
const float SSIM_C1 = 0.0001;
const float SSIM_C2 = 0.0009;
