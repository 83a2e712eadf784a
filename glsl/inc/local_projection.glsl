// Projection of a Gaussian that is linearised around its centre, as R2-Gaussian and X-Gaussian have it, with the intermediate results
// from which gradients are computed. Reference implementations: src/methods/{r2_gaussian,x_gaussian}/twin.rs.
// Files that include this one include inc/gaussian.glsl first.

// Distance from the image's middle, in half images, at which the slopes of a projection are limited. A centre further outside
// has the slopes at this border.
const float SLOPES_END = 1.3;
// Minimum squared difference of a splat's variances along its axes, pixels^4, in the computation of its radius.
const float MIN_SPREAD = 0.1;

struct LocalProjection {
    float depth;
    vec2 mean;
    // Image coordinates at which the slopes are taken: those of the centre, or of the border.
    vec2 held;
    // Per image axis, 1 if the slopes are those at the centre itself, 0 if they are those at the border.
    vec2 follows;
    vec3 column_slope;
    vec3 row_slope;
    // Slopes along the Gaussian's axes times its scales.
    vec3 alpha;
    vec3 beta;
    vec3 scale;
    mat3 axes;
};

// `position` in world units, `rotation` as a raw quaternion, `scale` as standard deviations along the axes.
LocalProjection project_locally(vec3 position, vec4 rotation, vec3 scale, GaussianView view, GaussianSetup setup) {
    LocalProjection p;
    vec4 x = vec4(position, 1.0);
    p.depth = dot(view.depth, x);
    float z = p.depth;
    p.mean = vec2(dot(view.column, x), dot(view.row, x)) / z;
    vec2 size = vec2(float(setup.width), float(setup.height));
    vec2 middle = 0.5 * (size - 1.0);
    p.held = clamp(p.mean, middle - 0.5 * SLOPES_END * size, middle + 0.5 * SLOPES_END * size);
    p.follows = vec2(equal(p.held, p.mean));
    p.column_slope = (view.column.xyz - p.held.x * view.depth.xyz) / z;
    p.row_slope = (view.row.xyz - p.held.y * view.depth.xyz) / z;
    p.axes = rotation_matrix(normalize(rotation));
    p.scale = scale;
    p.alpha = p.scale * (p.column_slope * p.axes);
    p.beta = p.scale * (p.row_slope * p.axes);
    return p;
}

// Variance in the image: along columns, mixed, along rows.
vec3 variance_of(LocalProjection p) {
    return vec3(dot(p.alpha, p.alpha), dot(p.alpha, p.beta), dot(p.beta, p.beta));
}

// Variance along the longest axis of a splat with a `variance` of determinant `det`.
float largest_variance(vec3 variance, float det) {
    float half_sum = 0.5 * (variance.x + variance.z);
    return half_sum + sqrt(max(MIN_SPREAD, half_sum * half_sum - det));
}
