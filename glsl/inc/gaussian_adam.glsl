// Adam's step for a gradient; updates its moments. Needs `setup`.
vec4 adam(vec4 g, vec4 rate, GaussianSchedule now, inout vec4 first, inout vec4 second) {
    first = setup.beta1 * first + (1.0 - setup.beta1) * g;
    second = setup.beta2 * second + (1.0 - setup.beta2) * g * g;
    return now.rate / now.bias1 * rate * first / (sqrt(second / now.bias2) + setup.epsilon);
}
