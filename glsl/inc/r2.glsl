// Projection of the Gaussians of R2-Gaussian in a cone beam, with the intermediate results from which their gradient is
// computed. Reference implementation: src/methods/r2_gaussian/twin.rs.
#include "inc/gaussian.glsl"
#include "inc/gaussian_gradient.glsl"
#include "inc/local_projection.glsl"
#include "inc/picture_layout.glsl"
#include "inc/r2_layout.glsl"
#include "inc/softplus.glsl"

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
    LocalProjection at;
    Splat splat;
    // Ray of the slopes.
    vec3 ray;
};

// The projection is affine around the centre. The amplitude is the line integral of the affine Gaussian along the ray of its
// slopes.
R2Projection project_r2(R2Gaussian g, GaussianView view, GaussianSetup setup) {
    R2Projection p;
    p.at = project_locally(g.position, g.rotation, scale_of(g, setup), view, setup);
    float z = p.at.depth;
    p.ray = view.d0.xyz + p.at.held.x * view.du.xyz + p.at.held.y * view.dv.xyz;
    vec3 variance = variance_of(p.at);
    float det = dot(cross(p.at.alpha, p.at.beta), cross(p.at.alpha, p.at.beta));
    p.splat.mean = p.at.mean;
    p.splat.conic = vec3(variance.z, -variance.y, variance.x) / det;
    float volume = p.at.scale.x * p.at.scale.y * p.at.scale.z;
    p.splat.amplitude = density_of(g) * SQRT_TWO_PI * volume * length(p.ray) * view.d0.w / (z * z * sqrt(det));
    p.splat.half_box = vec2(ceil(setup.cut * sqrt(largest_variance(variance, det))));
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
    vec3 d_alpha = 2.0 * (variance[0][0] * p.at.alpha + variance[0][1] * p.at.beta);
    vec3 d_beta = 2.0 * (variance[0][1] * p.at.alpha + variance[1][1] * p.at.beta);
    vec3 d_column_slope = p.at.axes * (p.at.scale * d_alpha);
    vec3 d_row_slope = p.at.axes * (p.at.scale * d_beta);
    float z = p.at.depth;
    // Contribution of the slopes and the ray where they depend on the centre.
    vec2 d_held = -vec2(dot(view.depth.xyz, d_column_slope), dot(view.depth.xyz, d_row_slope)) / z;
    d_held += linear.x / dot(p.ray, p.ray) * vec2(dot(p.ray, view.du.xyz), dot(p.ray, view.dv.xyz));
    vec2 d_mean = conic * linear.yz + p.at.follows * d_held;
    float d_depth = -(dot(p.at.column_slope, d_column_slope) + dot(p.at.row_slope, d_row_slope) + 2.0 * linear.x) / z;
    vec3 column = (view.column.xyz - p.splat.mean.x * view.depth.xyz) / z;
    vec3 row = (view.row.xyz - p.splat.mean.y * view.depth.xyz) / z;
    GaussianGradient gradient;
    gradient.position = d_mean.x * column + d_mean.y * row + d_depth * view.depth.xyz;
    gradient.log_density = linear.x;
    gradient.log_scale = p.at.alpha * d_alpha + p.at.beta * d_beta + linear.x;
    mat3 d_axes;
    for (int k = 0; k < 3; k++)
        d_axes[k] = p.at.scale[k] * (d_alpha[k] * p.at.column_slope + d_beta[k] * p.at.row_slope);
    gradient.rotation = rotation_gradient(g.rotation, d_axes);
    return gradient;
}
