// Projection of the Gaussians of R2-Gaussian in a cone beam, with the intermediate results from which their gradient is
// computed. Reference implementation: src/methods/r2_gaussian/twin.rs.
#include "inc/gaussian.glsl"
#include "inc/gaussian_gradient.glsl"
#include "inc/r2_layout.glsl"
#include "inc/softplus.glsl"

// Distance from the image's middle, in half images, at which the slopes of a projection are limited. A centre further outside
// has the slopes at this border.
const float SLOPES_END = 1.3;
// Minimum squared difference of a splat's variances along its axes, pixels^4, in the computation of its radius.
const float MIN_SPREAD = 0.1;
// Threshold below which softplus equals the exponential function in f32.
const float LOWEST = -80.0;

float density_of(R2Gaussian g) {
    return softplus(g.density);
}

// Derivative of the density's logarithm with respect to the stored number.
float density_slope(R2Gaussian g) {
    float x = max(g.density, LOWEST);
    return sigmoid(x) / softplus(x);
}

vec3 share_of_range(R2Gaussian g) {
    return vec3(sigmoid(g.scale.x), sigmoid(g.scale.y), sigmoid(g.scale.z));
}

vec3 scale_of(R2Gaussian g, GaussianSetup setup) {
    return setup.min_scale + (setup.max_scale - setup.min_scale) * share_of_range(g);
}

// Derivatives of the scales' logarithms with respect to the stored numbers.
vec3 scale_slope(R2Gaussian g, GaussianSetup setup) {
    vec3 share = share_of_range(g);
    return (setup.max_scale - setup.min_scale) * share * (1.0 - share) / scale_of(g, setup);
}

struct R2Projection {
    Splat splat;
    float depth;
    // Per image axis, 1 if the slopes are those at the centre itself, 0 if they are those at the border.
    vec2 follows;
    vec3 ray;
    vec3 column_slope;
    vec3 row_slope;
    // Slopes along the Gaussian's axes times its scales.
    vec3 alpha;
    vec3 beta;
    vec3 scale;
    mat3 axes;
};

// The projection is affine around the centre. The amplitude is the line integral of the affine Gaussian along the ray of its
// slopes.
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
    float largest = half_sum + sqrt(max(MIN_SPREAD, half_sum * half_sum - det));
    p.splat.half_box = vec2(ceil(setup.cut * sqrt(largest)));
    // A Gaussian behind the source is not visible.
    if (!(z > 0.0)) p.splat.half_box = vec2(-1.0);
    return p;
}

// Gradient with respect to position, logarithms of density and scales, and raw quaternion. `linear` = h (1, du, dv) and
// `square` = h (du^2, du dv, dv^2), summed over the pixels.
GaussianGradient gradient_r2(R2Gaussian g, R2Projection p, GaussianView view, vec3 linear, vec3 square) {
    mat2 conic = mat2(p.splat.conic.x, p.splat.conic.y, p.splat.conic.y, p.splat.conic.z);
    mat2 second = mat2(square.x, square.y, square.y, square.z);
    // This is dL / d(2D variance), including the determinant in the amplitude.
    mat2 variance = 0.5 * (conic * second * conic - linear.x * conic);
    vec3 d_alpha = 2.0 * (variance[0][0] * p.alpha + variance[0][1] * p.beta);
    vec3 d_beta = 2.0 * (variance[0][1] * p.alpha + variance[1][1] * p.beta);
    vec3 d_column_slope = p.axes * (p.scale * d_alpha);
    vec3 d_row_slope = p.axes * (p.scale * d_beta);
    float z = p.depth;
    // Contribution of the slopes and the ray where they depend on the centre.
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
