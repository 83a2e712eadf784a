// Gradient of a Gaussian's parameters from the moments of an image. Reference implementation: crates/twins/src/reference/gaussians.rs.

struct GaussianGradient {
    vec3 position;
    float log_density;
    vec3 log_scale;
    vec4 rotation;
};

GaussianGradient no_gradient() {
    return GaussianGradient(vec3(0.0), 0.0, vec3(0.0), vec4(0.0));
}

// Gradient with respect to the raw quaternion, which is normalised here, from the gradient of the axes (columns of the
// rotation).
vec4 rotation_gradient(vec4 raw, mat3 d) {
    float norm = length(raw);
    vec4 q = raw / norm;
    float w = q.x, x = q.y, y = q.z, z = q.w;
    // The element d[c][r] belongs to row r, column c.
    vec4 g = 2.0 * vec4(
        x * (d[1][2] - d[2][1]) + y * (d[2][0] - d[0][2]) + z * (d[0][1] - d[1][0]),
        w * (d[1][2] - d[2][1]) - 2.0 * x * (d[1][1] + d[2][2]) + y * (d[0][1] + d[1][0]) + z * (d[0][2] + d[2][0]),
        w * (d[2][0] - d[0][2]) + x * (d[0][1] + d[1][0]) - 2.0 * y * (d[0][0] + d[2][2]) + z * (d[1][2] + d[2][1]),
        w * (d[0][1] - d[1][0]) + x * (d[0][2] + d[2][0]) + y * (d[1][2] + d[2][1]) - 2.0 * z * (d[0][0] + d[1][1]));
    return (g - q * dot(q, g)) / norm;
}

// `linear` = h (1, du, dv) and `square` = h (du^2, du dv, dv^2), summed over the pixels.
void add_gradient(Gaussian g, Projection p, GaussianView view, GaussianSetup setup, vec3 linear, vec3 square,
                  inout GaussianGradient sum) {
    mat2 conic = mat2(p.splat.conic.x, p.splat.conic.y, p.splat.conic.y, p.splat.conic.z);
    mat2 second = mat2(square.x, square.y, square.y, square.z);
    // This is dL / d(2D variance), including the determinant in the amplitude.
    mat2 variance = 0.5 * (conic * second * conic - linear.x * conic);
    vec3 d_alpha = 2.0 * (variance[0][0] * p.alpha + variance[0][1] * p.beta);
    vec3 d_beta = 2.0 * (variance[0][1] * p.alpha + variance[1][1] * p.beta);
    vec2 d_mean = conic * linear.yz;
    // Contribution of the slopes, which depend on mean and depth.
    vec3 d_column_slope = p.axes * (p.scale * d_alpha);
    vec3 d_row_slope = p.axes * (p.scale * d_beta);
    float z = p.depth;
    d_mean -= vec2(dot(view.depth.xyz, d_column_slope), dot(view.depth.xyz, d_row_slope)) / z;
    float d_depth = -(dot(p.column_slope, d_column_slope) + dot(p.row_slope, d_row_slope)) / z;
    // Contribution of the amplitude, which depends on the ray's length and the depth.
    d_mean += linear.x / dot(p.ray, p.ray) * vec2(dot(p.ray, view.du.xyz), dot(p.ray, view.dv.xyz));
    d_depth -= 2.0 * linear.x / z;
    sum.position += d_mean.x * p.column_slope + d_mean.y * p.row_slope + d_depth * view.depth.xyz;
    sum.log_density += linear.x;
    vec3 free = exp(g.log_scale);
    vec3 inside = vec3(greaterThan(free, vec3(setup.min_scale))) * vec3(lessThan(free, vec3(setup.max_scale)));
    sum.log_scale += inside * (p.alpha * d_alpha + p.beta * d_beta + linear.x);
    mat3 d_axes;
    for (int k = 0; k < 3; k++)
        d_axes[k] = p.scale[k] * (d_alpha[k] * p.column_slope + d_beta[k] * p.row_slope);
    sum.rotation += rotation_gradient(g.rotation, d_axes);
}
