# The program on a CPU driver (lavapipe), for machines with nothing but a container engine:
#   tools/package && docker build --tag nertca-vk .
#   docker run --rm --volume "$PWD/out:/data" nertca-vk phantom phantom
#   docker run --rm --volume "$PWD/out:/data" nertca-vk train phantom -o run
# Device nodes of a GPU and its driver's libraries may be given to it as for any Vulkan program; lavapipe then stands back.
FROM debian:12-slim
RUN apt-get update -qq \
 && apt-get install -y -qq --no-install-recommends libvulkan1 mesa-vulkan-drivers \
 && rm -rf /var/lib/apt/lists/*
# The directory in the archive has the version in its name.
ADD target/packages/nertca-vk-*-linux.tar.gz /opt/
RUN ln -s /opt/nertca-vk-*-linux /opt/nertca-vk && /opt/nertca-vk/bin/nertca-vk devices
ENV PATH=/opt/nertca-vk/bin:$PATH
WORKDIR /data
ENTRYPOINT ["nertca-vk"]
