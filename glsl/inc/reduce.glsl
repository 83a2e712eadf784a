// Sums and maxima over a workgroup in a fixed order; every lane gets the result.
#include "inc/combine.glsl"

REDUCE(float, workgroup_sum, sum_scratch, SUM_OF, gl_WorkGroupSize.x)
REDUCE(vec4, workgroup_sum, sum4_scratch, SUM_OF, gl_WorkGroupSize.x)
REDUCE(float, workgroup_max, max_scratch, max, gl_WorkGroupSize.x)
