// Indices of workgroups and invocations that are distributed over two axes, because one axis may be too short. This file must
// be included after the layout with the size of the workgroup, which would count as 1 otherwise.

uint workgroup() {
    return gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x;
}

uint invocation() {
    return workgroup() * gl_WorkGroupSize.x + gl_LocalInvocationID.x;
}
