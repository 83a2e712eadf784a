// Counts workgroups and invocations that lie along two axes: there may be more than one axis takes.
// Included behind the layout that gives the size of the workgroup, without which it would count as 1.

uint workgroup() {
    return gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x;
}

uint invocation() {
    return workgroup() * gl_WorkGroupSize.x + gl_LocalInvocationID.x;
}
