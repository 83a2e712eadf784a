// Adam's step for a gradient; the function updates the moments. The including file must declare `gaussian_setup`.
vec4 adam(vec4 g, vec4 rate, GaussianSchedule now, inout vec4 first, inout vec4 second) {
    first = gaussian_setup.beta1 * first + (1.0 - gaussian_setup.beta1) * g;
    second = gaussian_setup.beta2 * second + (1.0 - gaussian_setup.beta2) * g * g;
    return now.rate / now.bias1 * rate * first / (sqrt(second / now.bias2) + gaussian_setup.epsilon);
}
