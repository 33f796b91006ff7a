// Times native OctoMap, shows which cells it touches, and what its colour tree allocates.
//
//   octomap_driver insert CLOUDS RESOLUTION DISCRETIZE MAX_RANGE   processor time of each insertPointCloud [ns], one a line
//   octomap_driver keys CLOUDS RESOLUTION DISCRETIZE MAX_RANGE     cells of each cloud, to standard output as int32:
//                                                                  free count, keys, occupied count, keys
//   octomap_driver memory CLOUDS RESOLUTION DISCRETIZE MAX_RANGE   of one ColorOcTree with all clouds: allocated bytes,
//                                                                  memoryUsage(), nodes, finest cells
//
// clouds.hpp describes CLOUDS. The caller pins the process to a core.

#include <malloc.h>

#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <vector>

#include <octomap/ColorOcTree.h>
#include <octomap/OcTree.h>

#include "clouds.hpp"

struct Cloud {
  octomap::point3d origin;
  octomap::Pointcloud points;
  std::vector<uint8_t> classes;
};

std::vector<Cloud> octomapClouds(const char* path) {
  std::vector<Cloud> clouds;
  for (const RawCloud& raw : readClouds(path)) {
    Cloud& cloud = clouds.emplace_back();
    cloud.origin = octomap::point3d(raw.origin[0], raw.origin[1], raw.origin[2]);
    cloud.points.reserve(raw.points.size() / 3);
    for (std::size_t i = 0; i < raw.points.size(); i += 3) {
      cloud.points.push_back(raw.points[i], raw.points[i + 1], raw.points[i + 2]);
    }
    cloud.classes = raw.classes;
  }
  return clouds;
}

void writeKeys(const octomap::KeySet& keys) {
  std::vector<int32_t> values{static_cast<int32_t>(keys.size())};
  for (const octomap::OcTreeKey& key : keys) {
    for (int axis = 0; axis < 3; ++axis) values.push_back(static_cast<int32_t>(key[axis]) - 32768);
  }
  std::fwrite(values.data(), sizeof(int32_t), values.size(), stdout);
}

std::size_t allocatedBytes() {
  const struct mallinfo2 info = mallinfo2();
  return info.uordblks + info.hblkhd;
}

// Finest cells that the leaves stand for.
std::size_t countCells(const octomap::ColorOcTree& tree) {
  std::size_t cells = 0;
  for (auto leaf = tree.begin_leafs(), end = tree.end_leafs(); leaf != end; ++leaf) {
    cells += std::size_t{1} << (3 * (tree.getTreeDepth() - leaf.getDepth()));
  }
  return cells;
}

int main(int argc, char** argv) {
  if (argc != 6) {
    std::fprintf(stderr, "usage: octomap_driver insert|keys|memory CLOUDS RESOLUTION DISCRETIZE MAX_RANGE\n");
    return 2;
  }
  const std::string mode = argv[1];
  const std::vector<Cloud> clouds = octomapClouds(argv[2]);
  const double resolution = std::atof(argv[3]);
  const bool discretize = std::atoi(argv[4]) != 0;
  const double maxRange = std::atof(argv[5]);
  if (mode == "insert") {
    octomap::OcTree tree(resolution);
    for (const Cloud& cloud : clouds) {
      const long long start = processorTime();
      tree.insertPointCloud(cloud.points, cloud.origin, maxRange, false, discretize);
      std::printf("%lld\n", processorTime() - start);
    }
  } else if (mode == "keys") {
    octomap::OcTree tree(resolution);
    for (const Cloud& cloud : clouds) {
      octomap::KeySet free, occupied;
      if (discretize) {
        tree.computeDiscreteUpdate(cloud.points, cloud.origin, free, occupied, maxRange);
      } else {
        tree.computeUpdate(cloud.points, cloud.origin, free, occupied, maxRange);
      }
      writeKeys(free);
      writeKeys(occupied);
    }
  } else if (mode == "memory") {
    const std::size_t before = allocatedBytes();
    octomap::ColorOcTree tree(resolution);
    for (const Cloud& cloud : clouds) {
      tree.insertPointCloud(cloud.points, cloud.origin, maxRange, false, discretize);
      for (std::size_t i = 0; i < cloud.points.size(); ++i) {
        const uint8_t shade = static_cast<uint8_t>(30 * cloud.classes[i]);
        tree.setNodeColor(cloud.points[i].x(), cloud.points[i].y(), cloud.points[i].z(), shade, shade, shade);
      }
    }
    tree.prune();
    const std::size_t after = allocatedBytes();
    std::printf("%zu %zu %zu %zu\n", after - before, tree.memoryUsage(), tree.size(), countCells(tree));
  } else {
    std::fprintf(stderr, "unknown mode %s\n", mode.c_str());
    return 2;
  }
  return 0;
}
