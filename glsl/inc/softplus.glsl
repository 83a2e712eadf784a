// Softplus that is accurate for small values, for which log(1 + y) is not: the function then uses the series of log1p. torch
// switches to the identity at 20 as well.
float softplus(float x) {
    if (x > 20.0) return x;
    float y = exp(x);
    if (y < 0.01) return y * (1.0 - y * (0.5 - y * (1.0 / 3.0 - y * 0.25)));
    return log(1.0 + y);
}

float sigmoid(float x) {
    return 1.0 / (1.0 + exp(-x));
}
