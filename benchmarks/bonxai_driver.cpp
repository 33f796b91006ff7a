// Times Bonxai's probabilistic map, and shows which cells it touches.
//
//   bonxai_driver insert CLOUDS RESOLUTION MAX_RANGE   processor time of each insertPointCloud [ns], one a line
//   bonxai_driver keys CLOUDS RESOLUTION MAX_RANGE     cells of each cloud in a map of its own, to standard output as
//                                                      int32: free count, keys, occupied count, keys
//
// clouds.hpp describes CLOUDS. The caller pins the process to a core.

#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <vector>

// bonxai.hpp uses std::ostream and std::log without their headers.
#include <cmath>
#include <iostream>

#include <bonxai_map/probabilistic_map.hpp>

#include "clouds.hpp"

using Point = Bonxai::ProbabilisticMap::Vector3D;

struct Cloud {
  Point origin;
  std::vector<Point> points;
};

std::vector<Cloud> bonxaiClouds(const char* path) {
  std::vector<Cloud> clouds;
  for (const RawCloud& raw : readClouds(path)) {
    Cloud& cloud = clouds.emplace_back();
    cloud.origin = Point(raw.origin[0], raw.origin[1], raw.origin[2]);
    cloud.points.reserve(raw.points.size() / 3);
    for (std::size_t i = 0; i < raw.points.size(); i += 3) {
      cloud.points.emplace_back(raw.points[i], raw.points[i + 1], raw.points[i + 2]);
    }
  }
  return clouds;
}

void writeKeys(const std::vector<Bonxai::CoordT>& keys) {
  std::vector<int32_t> values{static_cast<int32_t>(keys.size())};
  for (const Bonxai::CoordT& key : keys) values.insert(values.end(), {key.x, key.y, key.z});
  std::fwrite(values.data(), sizeof(int32_t), values.size(), stdout);
}

int main(int argc, char** argv) {
  if (argc != 5) {
    std::fprintf(stderr, "usage: bonxai_driver insert|keys CLOUDS RESOLUTION MAX_RANGE\n");
    return 2;
  }
  const std::string mode = argv[1];
  const std::vector<Cloud> clouds = bonxaiClouds(argv[2]);
  const double resolution = std::atof(argv[3]);
  const double maxRange = std::atof(argv[4]);
  if (mode == "insert") {
    Bonxai::ProbabilisticMap map(resolution);
    for (const Cloud& cloud : clouds) {
      const long long start = processorTime();
      map.insertPointCloud(cloud.points, cloud.origin, maxRange);
      std::printf("%lld\n", processorTime() - start);
    }
  } else if (mode == "keys") {
    for (const Cloud& cloud : clouds) {
      Bonxai::ProbabilisticMap map(resolution);
      map.insertPointCloud(cloud.points, cloud.origin, maxRange);
      std::vector<Bonxai::CoordT> free, occupied;
      map.getFreeVoxels(free);
      map.getOccupiedVoxels(occupied);
      writeKeys(free);
      writeKeys(occupied);
    }
  } else {
    std::fprintf(stderr, "unknown mode %s\n", mode.c_str());
    return 2;
  }
  return 0;
}
