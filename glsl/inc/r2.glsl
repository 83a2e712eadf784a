// How a cone beam sees the Gaussians of R2-Gaussian, and what of it their gradient needs. Twin: src/reference/r2.rs.
#include "inc/gaussian.glsl"
#include "inc/gaussian_gradient.glsl"
#include "inc/r2_layout.glsl"
#include "inc/softplus.glsl"

// The slopes of a projection are those at the image's border, this many half images from its middle, for all that is
// beyond.
const float SLOPES_END = 1.3;
// Least squared difference of a splat's variances along its axes, pixels^4, when its radius is found.
const float LEAST_SPREAD = 0.1;
// Below this, softplus is the exponential to all digits.
const float LOWEST = -80.0;

float density_of(R2Gaussian g) {
    return softplus(g.density);
}

// Slope of the density's logarithm by what is stored.
float density_slope(R2Gaussian g) {
    float x = max(g.density, LOWEST);
    return sigmoid(x) / softplus(x);
}

vec3 share_of_range(R2Gaussian g) {
    return vec3(sigmoid(g.scale.x), sigmoid(g.scale.y), sigmoid(g.scale.z));
}

vec3 scale_of(R2Gaussian g, GaussianSetup setup) {
    return setup.least_scale + (setup.greatest_scale - setup.least_scale) * share_of_range(g);
}

// Slopes of the scales' logarithms by what is stored.
vec3 scale_slope(R2Gaussian g, GaussianSetup setup) {
    vec3 share = share_of_range(g);
    return (setup.greatest_scale - setup.least_scale) * share * (1.0 - share) / scale_of(g, setup);
}

struct R2Projection {
    Splat splat;
    float depth;
    // 1 along image axes where slopes are those at the centre itself, 0 where they are the border's.
    vec2 follows;
    vec3 ray;
    vec3 column_slope;
    vec3 row_slope;
    // Slopes along the Gaussian's axes, times its scales.
    vec3 alpha;
    vec3 beta;
    vec3 scale;
    mat3 axes;
};

// Affine around the centre; the amplitude is the line integral of the affine Gaussian along the ray of its slopes.
R2Projection project_r2(R2Gaussian g, GaussianView view, GaussianSetup setup) {
    R2Projection p;
    vec4 x = vec4(g.position, 1.0);
    p.depth = dot(view.depth, x);
    float z = p.depth;
    vec2 mean = vec2(dot(view.column, x), dot(view.row, x)) / z;
    vec2 size = vec2(float(setup.width), float(setup.height));
    vec2 middle = 0.5 * (size - 1.0);
    vec2 held = clamp(mean, middle - 0.5 * SLOPES_END * size, middle + 0.5 * SLOPES_END * size);
    p.follows = vec2(equal(held, mean));
    p.column_slope = (view.column.xyz - held.x * view.depth.xyz) / z;
    p.row_slope = (view.row.xyz - held.y * view.depth.xyz) / z;
    p.ray = view.d0.xyz + held.x * view.du.xyz + held.y * view.dv.xyz;
    p.axes = rotation_matrix(normalize(g.rotation));
    p.scale = scale_of(g, setup);
    p.alpha = p.scale * (p.column_slope * p.axes);
    p.beta = p.scale * (p.row_slope * p.axes);
    vec3 variance = vec3(dot(p.alpha, p.alpha), dot(p.alpha, p.beta), dot(p.beta, p.beta));
    float det = dot(cross(p.alpha, p.beta), cross(p.alpha, p.beta));
    p.splat.mean = mean;
    p.splat.conic = vec3(variance.z, -variance.y, variance.x) / det;
    float volume = p.scale.x * p.scale.y * p.scale.z;
    p.splat.amplitude = density_of(g) * SQRT_TWO_PI * volume * length(p.ray) * view.d0.w / (z * z * sqrt(det));
    float half_sum = 0.5 * (variance.x + variance.z);
    float largest = half_sum + sqrt(max(LEAST_SPREAD, half_sum * half_sum - det));
    p.splat.half_box = vec2(ceil(setup.cut * sqrt(largest)));
    // Behind the source nothing is seen.
    if (!(z > 0.0)) p.splat.half_box = vec2(-1.0);
    return p;
}

// Gradient by position, by the logarithms of density and scales, and by the raw quaternion. `linear` = h (1, du, dv),
// `square` = h (du^2, du dv, dv^2), summed over the pixels.
GaussianGradient gradient_r2(R2Gaussian g, R2Projection p, GaussianView view, vec3 linear, vec3 square) {
    mat2 conic = mat2(p.splat.conic.x, p.splat.conic.y, p.splat.conic.y, p.splat.conic.z);
    mat2 second = mat2(square.x, square.y, square.y, square.z);
    // dL / d(2D variance), the determinant in the amplitude included.
    mat2 variance = 0.5 * (conic * second * conic - linear.x * conic);
    vec3 d_alpha = 2.0 * (variance[0][0] * p.alpha + variance[0][1] * p.beta);
    vec3 d_beta = 2.0 * (variance[0][1] * p.alpha + variance[1][1] * p.beta);
    vec3 d_column_slope = p.axes * (p.scale * d_alpha);
    vec3 d_row_slope = p.axes * (p.scale * d_beta);
    float z = p.depth;
    // Through the slopes and the ray, where these follow the centre.
    vec2 d_held = -vec2(dot(view.depth.xyz, d_column_slope), dot(view.depth.xyz, d_row_slope)) / z;
    d_held += linear.x / dot(p.ray, p.ray) * vec2(dot(p.ray, view.du.xyz), dot(p.ray, view.dv.xyz));
    vec2 d_mean = conic * linear.yz + p.follows * d_held;
    float d_depth = -(dot(p.column_slope, d_column_slope) + dot(p.row_slope, d_row_slope) + 2.0 * linear.x) / z;
    vec3 column = (view.column.xyz - p.splat.mean.x * view.depth.xyz) / z;
    vec3 row = (view.row.xyz - p.splat.mean.y * view.depth.xyz) / z;
    GaussianGradient gradient;
    gradient.position = d_mean.x * column + d_mean.y * row + d_depth * view.depth.xyz;
    gradient.log_density = linear.x;
    gradient.log_scale = p.alpha * d_alpha + p.beta * d_beta + linear.x;
    mat3 d_axes;
    for (int k = 0; k < 3; k++)
        d_axes[k] = p.scale[k] * (d_alpha[k] * p.column_slope + d_beta[k] * p.row_slope);
    gradient.rotation = rotation_gradient(g.rotation, d_axes);
    return gradient;
}
